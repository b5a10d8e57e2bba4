// Inertias, forces, the mass matrix.

float implicit_damping[SLOTS];  // minus the derivative of the force of each own degree of freedom by its velocity

// Sets the accelerations of the own links at qacc = 0, or with qacc.
INLINE void accelerate(Motion* accelerations, const bool with_qacc) const {
  OWN_LINKS(slot, link) {
    const int b = link < Model::LINKS ? link : 0, parent = Model::parent(b), end = Model::first_joint(b + 1);
    Motion velocity = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}}, acceleration = velocity;
    if (parent >= 0) velocity = w.velocity[parent];
    ROLLED_FOR(int j = Model::first_joint(b); j < end; ++j) {
      int d = Model::joint_dof(j);
      const int kind = Model::joint_kind(j);
      if (Model::HAS_FREE && kind == FREE) {  // its translations have axes that do not move
        velocity.linear = velocity.linear + Vec{w.qvel[d], w.qvel[d + 1], w.qvel[d + 2]};
        if (with_qacc) acceleration.linear = acceleration.linear + Vec{w.qacc[d], w.qacc[d + 1], w.qacc[d + 2]};
        d += 3;
      }
      Motion relative = w.axes[d] * w.qvel[d];
      if (Model::QUATERNIONS > 0 && kind <= BALL)
        relative = relative + w.axes[d + 1] * w.qvel[d + 1] + w.axes[d + 2] * w.qvel[d + 2];
      acceleration = acceleration + Spatial::cross_motion(velocity, relative);
      velocity = velocity + relative;
      const int last = d + (Model::QUATERNIONS > 0 && kind <= BALL ? 3 : 1);
      if (with_qacc)
        ROLLED_FOR(; d < last; ++d) acceleration = acceleration + w.axes[d] * w.qacc[d];
    }
    accelerations[slot] = acceleration;
  }
  sum_to_root(accelerations);
}

// Bias forces (Coriolis, centrifugal, gravity) and inertias of the links, by recursive Newton-Euler; then both of
// each subtree, which is all that the mass matrix needs (composite rigid bodies).
INLINE void subtrees() {
  Motion accelerations[LINK_SLOTS];
  accelerate(accelerations, false);
  if (Model::WELD_ROWS > 0) accelerate_welds(accelerations);
  OWN_LINKS(slot, b) {
    if (b >= Model::LINKS) continue;
    const Motion velocity = w.velocity[b];
    Motion acceleration = accelerations[slot];
    acceleration.linear = acceleration.linear - Model::gravity(0);
    const Pose pose = w.pose[b];
    const float mass = Model::link_mass(b);
    const Vec offset = center_of_mass(b, pose) - w.com[Model::tree(b)];
    const Inertia inertia = Spatial::moved(Model::link_inertia(b).turned(pose.orientation), mass, offset);
    const Motion momentum = Spatial::product(inertia, velocity);
    const Motion force = Spatial::product(inertia, acceleration) + Spatial::cross_force(velocity, momentum);
    w.bodies[b] = {inertia, force.angular, force.linear};
  }
  sync();
  float* const bodies = reinterpret_cast<float*>(w.bodies);
  if (LANES == 1) {
    for (int b = Model::LINKS - 1; b > 0; --b)
      if (Model::parent(b) >= 0)
        for (int i = 0; i < 16; ++i) bodies[16 * Model::parent(b) + i] += bodies[16 * b + i];
  } else if (lane < 16) {  // a lane for each of the 16 numbers of a body
    float total[Model::LINKS];
    UNROLLED_FOR(int b = 0; b < Model::LINKS; ++b) total[b] = bodies[16 * b + lane];
    Model::add_children(total);
    UNROLLED_FOR(int b = 0; b < Model::LINKS; ++b) bodies[16 * b + lane] = total[b];
  }
  sync();
}

//ACTUATOR
INLINE float control_of(int a) const {
  return clamp(ctrl[Model::control(a)], Model::control_low(a), Model::control_high(a));
}

// Activations follow their controls, of which each step they take a share, and lose one of themselves.
INLINE void activate() {
  SHARED_LOOP(i, Model::ACTIVATIONS) {
    const float act = w.act()[i], control = control_of(Model::activated(i));
    const float next = act + (Model::inflow(i) * control - Model::outflow(i) * act);
    w.act()[i] = clamp(next, Model::act_low(i), Model::act_high(i));
  }
}

// Passive and actuator forces of a degree of freedom, and its damping: minus the derivative of the force by its
// velocity. MuJoCo leaves out of that actuators whose force a limit holds.
INLINE float joint_force(int d, float& damping) const {
  const int q = Model::dof_qpos(d);
  damping = Model::damping(d);
  float force = -damping * w.qvel[d], actuation = 0.0f;
  if (Model::HAS_SPRINGS) force = force - Model::stiffness(d) * (w.qpos[q] - Model::spring(q));
  const int end = Model::first_actuator(d + (Model::SUBSTEPS > 0));  // a step that is not taken has no actuation
  ROLLED_FOR(int a = Model::first_actuator(d); a < end; ++a) {
    const float gear = Model::gear(a);
    float position = w.qpos[q], velocity = w.qvel[d];
    if (Model::TENDONS) {
      position = velocity = 0.0f;
      ROLLED_FOR(int k = Model::first_pull(a); k < Model::first_pull(a + 1); ++k) {
        const int other = Model::pull_dof(k);
        position = position + Model::pull(k) * w.qpos[Model::dof_qpos(other)];
        velocity = velocity + Model::pull(k) * w.qvel[other];
      }
    }
    const float moment = gear * Model::own_pull(a);
    const int activation = Model::activation(a);
    const float input = Model::ACTIVATIONS == 0 ? ctrl[Model::control(a)]
                        : activation < 0        ? control_of(a)
                                                : w.act()[activation];
    const float f = actuator_force(a, input, position, velocity);
    if (Model::IMPLICIT_ACTUATORS && Model::force_low(a) < f && f < Model::force_high(a))
      damping = damping - gear * gear * Model::bias_velocity(a);
    if (Model::JOINT_FORCE_LIMITS) actuation = actuation + moment * f;
    else force = force + moment * f;
  }
  if (!Model::JOINT_FORCE_LIMITS) return force;
  const float low = Model::joint_force_low(d), high = Model::joint_force_high(d);
  if (!(low < actuation && actuation < high)) damping = Model::damping(d);
  return force + clamp(actuation, low, high);
}

// The mass matrix, and the residual: minus the smooth forces, until M qacc is added. Entries of degrees of freedom of
// which neither is an ancestor of the other stay zero. A lane has one of the entries off the diagonal.
INLINE void mass_matrix() {
  OWN_DOFS(slot, d) {
    if (d >= DOFS) continue;
    const Body body = w.bodies[Model::dof_link(d)];
    const Motion axis = w.axes[d], momentum = Spatial::product(body.inertia, axis), bias = {body.torque, body.force};
    w.residual[d] = axis.dot(bias) - joint_force(d, implicit_damping[slot]);
    w.mass[STRIDE * d + d] = axis.dot(momentum) + Model::armature(d);
    w.momentum[d] = momentum;
  }
  sync();
  SHARED_LOOP(i, Model::MASS_ENTRIES) {
    const unsigned entry = Model::mass_entry(i), d = entry / 64, ancestor = entry % 64;
    w.mass[STRIDE * d + ancestor] = w.mass[STRIDE * ancestor + d] = w.axes[ancestor].dot(w.momentum[d]);
  }
  sync();
}
