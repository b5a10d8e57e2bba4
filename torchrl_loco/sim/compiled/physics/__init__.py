"""The laws: joints, inertias, forces, constraints and what they cost, sensors. Each once, for both schedules."""
