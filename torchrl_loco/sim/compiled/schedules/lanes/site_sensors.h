// Sensors at sites, in the frames of these: velocities of the present state; accelerations and forces of the last substep.

// Where a site is from the centre of mass of its tree, and a vector in its frame.
INLINE Vec offset_of(int site) const {
  const int link = Model::frame_link(site);
  return w.pose[link].position + w.pose[link].orientation * Model::frame_position(site) - w.com[Model::tree(link)];
}
INLINE Vec in_frame(int site, Vec v) const {
  const Vec in_link = w.pose[Model::frame_link(site)].orientation.transposed_times(v);
  return Model::frame_orientation(site).transposed_times(in_link);
}
INLINE void write(int site, Vec v, float* sensordata) const {
  in_frame(site, v).write(sensordata + Model::frame_address(site));
}

INLINE void write_velocities(float* sensordata) const {
  SHARED_LOOP(s, Model::MOTION_SENSORS) {
    const Motion velocity = w.velocity[Model::frame_link(s)];
    write(s, Model::frame_turning(s) ? velocity.angular : velocity.at(offset_of(s)), sensordata);
  }
}

// This lane's share of the force in the joint above a subtree, about the centre of mass of its tree: what accelerates its
// parts, less what contacts push.
INLINE Motion own_wrench(int s, const Vec* pushes) const {
  Motion wrench = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}};
  const int end = Model::first_wrench_part(s + 1);
  ROLLED_FOR(int i = Model::first_wrench_part(s) + lane; i < end; i += LANES) {
    const int link = Model::wrench_link(i);
    const Pose pose = w.pose[link];
    const Vec offset = pose.position + pose.orientation * Model::wrench_center(i) - w.com[Model::tree(link)];
    const Symmetric moments = Model::wrench_inertia(i).turned(pose.orientation);
    const Inertia inertia = Spatial::moved(moments, Model::wrench_mass(i), offset);
    const Motion velocity = w.velocity[link], momentum = Spatial::product(inertia, velocity);
    wrench = wrench + Spatial::product(inertia, w.momentum[link]) + Spatial::cross_force(velocity, momentum);
  }
  const Vec between = w.com[0] - w.com[Model::tree(Model::frame_link(Model::FIRST_WRENCH + s))];
  UNROLLED_FOR(int own = 0; own < OWN_CONTACTS; ++own) {
    const int pair = own_contacts[own].pair;
    if (lane + LANES * own >= frictional + frictionless || pair >= Model::PAIRS) continue;
    const int first = Model::first_body(pair), second = Model::second_body(pair);
    const float sign =
        (float)(Model::in_subtree(Model::BODIES * s + first) - Model::in_subtree(Model::BODIES * s + second));
    const Vec push = pushes[own] * sign;
    wrench = wrench + Motion{(own_contacts[own].point + between).cross(push), push};
  }
  return wrench;
}

// After the solver, which has overwritten poses and velocities: they are found again.
INLINE void write_accelerations(float* sensordata) {
  Vec pushes[OWN_CONTACTS];
  UNROLLED_FOR(int own = 0; own < OWN_CONTACTS; ++own)
    if (Model::WRENCHES > 0 && lane + LANES * own < frictional + frictionless)
      pushes[own] = contact_force(lane + LANES * own, own_contacts[own]);
  sync();
  kinematics();
  Motion accelerations[LINK_SLOTS];
  accelerate(accelerations, true);
  OWN_LINKS(slot, b) {
    if (b >= Model::LINKS) continue;
    w.momentum[b] = accelerations[slot];  // in memory that is free now
    w.momentum[b].linear = w.momentum[b].linear - Model::gravity(0);
  }
  sync();
  SHARED_LOOP(i, Model::ACCELEROMETERS) {
    const int s = Model::MOTION_SENSORS + i, link = Model::frame_link(s);
    write(s, acceleration_at(w.momentum[link], w.velocity[link], offset_of(s)), sensordata);
  }
  ROLLED_FOR(int i = 0; i < Model::WRENCHES; ++i) {
    const int s = Model::FIRST_WRENCH + i;
    const Motion own = own_wrench(i, pushes);
    float total[6] = {own.angular.x, own.angular.y, own.angular.z, own.linear.x, own.linear.y, own.linear.z};
    sum(total, 6);
    const Vec torque = {total[0], total[1], total[2]}, force = {total[3], total[4], total[5]};
    if (lane == 0) write(s, Model::frame_turning(s) ? torque - offset_of(s).cross(force) : force, sensordata);
  }
  sync();
}
