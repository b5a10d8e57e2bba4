"""Verification: an exported policy, played in C MuJoCo on the robot's model at full accuracy.

What comes from an ONNX file alone needs MuJoCo, NumPy and onnxruntime; :mod:`.training_simulator` needs torch and the
task.
"""
