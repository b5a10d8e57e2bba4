// Poses and velocities of the links.

// What each link, or degree of freedom, has, from its owner: a number in each of its slots, which lie a stride apart.
INLINE float of_owner(const float* own, const int stride, const int slots, int i) const {
  float value = read(own[0], (unsigned)i % LANES);
  UNROLLED_FOR(int slot = 1; slot < slots; ++slot) {
    const float other = read(own[stride * slot], (unsigned)i % LANES);
    if (i / LANES == slot) value = other;
  }
  return value;
}
INLINE float of_link(const float* own, const int stride, int link) const {
  return of_owner(own, stride, LINK_SLOTS, link);
}

INLINE Vec of_link(const Vec* own, const int stride, int link) const {
  return {of_link(&own->x, stride, link), of_link(&own->y, stride, link), of_link(&own->z, stride, link)};
}
INLINE Motion of_link(const Motion* own, int link) const {
  enum { SIZE = sizeof(Motion) / sizeof(float) };
  return {of_link(&own->angular, SIZE, link), of_link(&own->linear, SIZE, link)};
}
INLINE LocalPose of_link(const LocalPose* own, int link) const {
  enum { SIZE = sizeof(LocalPose) / sizeof(float) };
  const Quat& q = own->orientation;
  return {{of_link(&q.w, SIZE, link), of_link(&q.x, SIZE, link), of_link(&q.y, SIZE, link), of_link(&q.z, SIZE, link)},
          of_link(&own->position, SIZE, link)};
}

// Adds to what each link has that of its ancestors, or puts its pose after theirs. In each round, a lane asks the
// ancestor that is as far away as the round before reached. A single lane visits the links in their order, parents
// first.
INLINE void sum_to_root(Motion* own) const {
  if (LANES == 1) {
    for (int b = 0; b < Model::LINKS; ++b)
      if (Model::parent(b) >= 0) own[b] = own[b] + own[Model::parent(b)];
    return;
  }
  ROLLED_FOR(int round = 0; round < Model::ROUNDS; ++round) {
    Motion others[LINK_SLOTS];
    int above[LINK_SLOTS];
    OWN_LINKS(slot, b) {
      above[slot] = Model::above(Model::LINKS * round + (b < Model::LINKS ? b : 0));
      others[slot] = of_link(own, above[slot]);
    }
    OWN_LINKS(slot, b)
      if (above[slot] >= 0) own[slot] = own[slot] + others[slot];
  }
}
INLINE void place_in_world(LocalPose* own) const {
  if (LANES == 1) {
    for (int b = 0; b < Model::LINKS; ++b)
      if (Model::parent(b) >= 0) own[b] = own[b].after(own[Model::parent(b)]);
    return;
  }
  ROLLED_FOR(int round = 0; round < Model::ROUNDS; ++round) {
    LocalPose others[LINK_SLOTS];
    int above[LINK_SLOTS];
    OWN_LINKS(slot, b) {
      above[slot] = Model::above(Model::LINKS * round + (b < Model::LINKS ? b : 0));
      others[slot] = of_link(own, above[slot]);
    }
    OWN_LINKS(slot, b)
      if (above[slot] >= 0) own[slot] = own[slot].after(others[slot]);
  }
}

INLINE Vec qpos_vec(int i) const { return {w.qpos[i], w.qpos[i + 1], w.qpos[i + 2]}; }
INLINE Quat qpos_quat(int i) const { return Quat{w.qpos[i], w.qpos[i + 1], w.qpos[i + 2], w.qpos[i + 3]}.normalized(); }

// The pose of a link relative to its parent; leaves axes and anchors of hinges and slides in the parent's frame.
INLINE LocalPose local_pose(int link) {
  Vec position = Model::link_position(link);
  Quat orientation = Model::link_orientation(link);
  const int end = Model::first_joint(link + 1);
  ROLLED_FOR(int j = Model::first_joint(link); j < end; ++j) {
    const int q = Model::joint_qpos(j), kind = Model::joint_kind(j);
    if (Model::HAS_FREE && kind == FREE) {
      position = qpos_vec(q);
      orientation = qpos_quat(q + 3);
      continue;
    }
    const Vec offset = Model::joint_position(j);
    const Vec anchor = Model::JOINTS_ASIDE ? position + orientation.rotate(offset) : position;
    if (Model::HAS_BALL && kind == BALL) {
      orientation = orientation * qpos_quat(q);
    } else {
      const Vec axis = Model::joint_axis(j), direction = Model::JOINTS_TURNED ? orientation.rotate(axis) : axis;
      const float displacement = w.qpos[q] - Model::joint_qpos0(j);
      w.axes[Model::joint_dof(j)] = {direction, anchor};
      if (Model::HAS_SLIDE && kind == SLIDE_JOINT) {
        position = position + direction * displacement;
        continue;
      }
      float sine, cosine;
      sincos(0.5f * displacement, sine, cosine);
      const Quat turn = {cosine, sine * axis.x, sine * axis.y, sine * axis.z};
      orientation = Model::JOINTS_TURNED ? orientation * turn : turn;
    }
    if (Model::JOINTS_ASIDE) position = anchor - orientation.rotate(offset);
  }
  return {orientation, position};
}

INLINE Pose pose_of(int link) const {
  if (link < 0) return {{{1.0f, 0.0f, 0.0f}, {0.0f, 1.0f, 0.0f}, {0.0f, 0.0f, 1.0f}}, {0.0f, 0.0f, 0.0f}};
  return w.pose[link];
}

INLINE Motion velocity_of(int link) const {
  if (link < 0) return {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}};
  return w.velocity[link];
}
// The acceleration of a point of a body, from that of the body as a spatial vector.
static INLINE Vec acceleration_at(Motion acceleration, Motion velocity, Vec point) {
  return acceleration.at(point) + velocity.angular.cross(velocity.at(point));
}

INLINE Vec center_of_mass(int link, const Pose& pose) const {
  return pose.position + pose.orientation * Model::link_center(link);
}

// Poses of the links, and the centres of mass of the trees.
INLINE void poses() {
  LocalPose own[LINK_SLOTS];
  OWN_LINKS(slot, b) own[slot] = local_pose(b < Model::LINKS ? b : 0);
  place_in_world(own);
  Vec moment = {0.0f, 0.0f, 0.0f};  // of the only tree, or of one after the other
  OWN_LINKS(slot, b) {
    if (b >= Model::LINKS) continue;
    const Pose pose = {Mat::from(own[slot].orientation), own[slot].position};
    w.pose[b] = pose;
    if (Model::TREES == 1) moment = moment + center_of_mass(b, pose) * Model::link_mass(b);
  }
  ROLLED_FOR(int t = 0; t < Model::TREES; ++t) {
    if (Model::TREES > 1) moment = {0.0f, 0.0f, 0.0f};
    SHARED_LOOP(b, Model::TREES > 1 ? Model::LINKS : 0)
      if (Model::tree(b) == t) moment = moment + center_of_mass(b, w.pose[b]) * Model::link_mass(b);
    float total[3] = {moment.x, moment.y, moment.z};
    sum(total, 3);
    w.com[t] = (Vec{total[0], total[1], total[2]} + Model::fixed_moment(t)) * Model::inverse_mass(t);
  }
  sync();
}

// The motion of the tree for a unit velocity of each degree of freedom, and the velocity of each link.
INLINE void velocities() {
  SHARED_LOOP(d, DOFS) {
    const int link = Model::dof_link(d), kind = Model::dof_kind(d), k = Model::dof_component(d);
    const Vec com = w.com[Model::tree(link)];
    Motion axis = w.axes[d];  // direction and anchor in the parent's frame
    if (kind == TRANSLATION) {
      axis = {{0.0f, 0.0f, 0.0f}, Vec::unit(k)};
    } else if (kind == ROTATION) {
      const Pose pose = w.pose[link];
      const Vec anchor = Model::HAS_BALL ? pose.position + pose.orientation * Model::dof_anchor(d) : pose.position;
      const Vec direction = pose.orientation.column(k);
      axis = Spatial::turning(direction, com - anchor);
    } else {
      const Pose parent = pose_of(Model::parent(link));
      const Vec direction = parent.orientation * axis.angular;
      const Vec anchor = parent.position + parent.orientation * axis.linear;
      axis = Spatial::turning(direction, com - anchor);
      if (Model::HAS_SLIDE && kind == SLIDE) axis = {{0.0f, 0.0f, 0.0f}, direction};
    }
    w.axes[d] = axis;
  }
  sync();
  Motion own[LINK_SLOTS];
  OWN_LINKS(slot, b) {
    const int end = b < Model::LINKS ? Model::first_dof(b + 1) : 0;
    int d = b < Model::LINKS ? Model::first_dof(b) : 0;
    Motion velocity = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}};
    if (Model::HAS_FREE && Model::dof_kind(d) == TRANSLATION) {  // along the axes of the world
      velocity.linear = velocity.linear + Vec{w.qvel[d], w.qvel[d + 1], w.qvel[d + 2]};
      d += 3;
    }
    ROLLED_FOR(; d < end; ++d) velocity = velocity + w.axes[d] * w.qvel[d];
    own[slot] = velocity;
  }
  sum_to_root(own);
  OWN_LINKS(slot, b)
    if (b < Model::LINKS) w.velocity[b] = own[slot];
  sync();
}

INLINE void kinematics() {
  poses();
  velocities();
}
