// Bodies, sensors and contact forces.

// What the solver overwrites of the contacts that this lane adds up: number lane, lane + LANES, ...
enum { OWN_CONTACTS = (CONTACTS + LANES - 1) / LANES };
struct OwnContact {
  Vec normal, tangent, point;
  int pair;
} own_contacts[OWN_CONTACTS];

// The sum of the normal forces of the contacts that each sensor feels.
INLINE void write_touch(float* sensordata) const {
  ROLLED_FOR(int s = 0; s < Model::TOUCH; ++s) {
    float force = 0.0f;
    if (Model::ELLIPTIC)
      SHARED_LOOP(k, frictional)
        if (w.zones[k] >> s & 1) force -= law(k).gradient[0];
    SHARED_LOOP(i, first_limit() - first_single()) {
      const int r = first_single() + i;
      const bool felt = w.zones[place_of(contact_of_row(r))] >> s & 1;
      if (felt) force -= OneSided::gradient(w.x[r], w.weight[r]);
    }
    sum(&force, 1);
    if (lane == 0) sensordata[Model::touch_address(s)] = force;
  }
}

// ---- Contact forces

INLINE void keep_contacts() {
  UNROLLED_FOR(int own = 0; own < OWN_CONTACTS; ++own) {
    const int i = lane + LANES * own;
    if (i >= frictional + frictionless) continue;
    const Contact c = contact(i);
    own_contacts[own].normal = own_contacts[own].tangent = c.normal;
    own_contacts[own].pair = c.pair();
    own_contacts[own].point = c.point;
    if (i < frictional) own_contacts[own].tangent = w.tangents[i] * Model::friction(c.pair());
  }
  sync();
}

// The force of an own contact on its second geom.
INLINE Vec contact_force(int i, const OwnContact& c) const {
  if (i >= frictional) {
    const int r = first_frictionless() + i - frictional;
    return c.normal * -OneSided::gradient(w.x[r], w.weight[r]);
  }
  const Law cost = law(i);
  return c.normal * -cost.gradient[0] + c.tangent * -cost.gradient[1] +
         second_tangent(c.normal, c.tangent, c.pair) * -cost.gradient[2];
}

// The sum of the contact forces on each geom, and whether there is a contact. A lane adds up those of its geoms.
INLINE void write_contact_forces(float* forces, bool* touches) const {
  enum { OWN_GEOMS = Model::CONTACT_GEOMS > 0 ? (Model::CONTACT_GEOMS + LANES - 1) / LANES : 1 };
  Vec total[OWN_GEOMS];
  bool touched[OWN_GEOMS];
  UNROLLED_FOR(int own = 0; own < OWN_GEOMS; ++own) {
    total[own] = {0.0f, 0.0f, 0.0f};
    touched[own] = false;
  }
  UNROLLED_FOR(int own = 0; own < OWN_CONTACTS; ++own) {
    const int left = frictional + frictionless - LANES * own, i = lane + LANES * own;
    if (left <= 0) break;
    Vec push = {0.0f, 0.0f, 0.0f};
    int first = -1, second = -1;
    if (lane < left) {
      const OwnContact c = own_contacts[own];
      push = contact_force(i, c);
      first = Model::first_contact_geom(c.pair);
      second = Model::second_contact_geom(c.pair);
    }
    const int end = left < LANES ? left : LANES;
    ROLLED_FOR(int from = 0; from < end; ++from) {
      const Vec force = {read(push.x, from), read(push.y, from), read(push.z, from)};
      const int minus = read(first, from), plus = read(second, from);
      UNROLLED_FOR(int own_geom = 0; own_geom < OWN_GEOMS; ++own_geom) {
        const int g = lane + LANES * own_geom;
        if (minus != g && plus != g) continue;
        total[own_geom] = total[own_geom] + force * (plus == g ? 1.0f : -1.0f);
        touched[own_geom] = true;
      }
    }
  }
  UNROLLED_FOR(int own = 0; own < OWN_GEOMS; ++own) {
    const int g = lane + LANES * own;
    if (g >= Model::CONTACT_GEOMS) break;
    total[own].write(forces + 3 * g);
    touches[g] = touched[own];
  }
}

// Poses of all bodies, and their velocities unless nobody asked for them.
INLINE void write_bodies(float* xpos, float* xmat, float* cvel) const {
  SHARED_LOOP(b, Model::BODIES) {
    const int link = Model::body_link(b);
    const Pose pose = pose_of(link);
    (pose.position + pose.orientation * Model::body_position(b)).write(xpos + 3 * b);
    const Mat orientation = Model::body_orientation(b);
    const Motion velocity = velocity_of(link);
    UNROLLED_FOR(int i = 0; i < 3; ++i) {
      const Vec column = pose.orientation * orientation.column(i);
      xmat[9 * b + i] = column.x;
      xmat[9 * b + 3 + i] = column.y;
      xmat[9 * b + 6 + i] = column.z;
      if (!cvel) continue;
      cvel[6 * b + i] = velocity.angular.component(i);
      cvel[6 * b + 3 + i] = velocity.linear.component(i);
    }
  }
}

// Centres of mass of the trees, in the rows of their roots.
INLINE void write_centers(float* subtree_com) const {
  SHARED_LOOP(t, Model::TREES) w.com[t].write(subtree_com + 3 * Model::root_body(t));
}

// Momentum of a subtree over its mass.
INLINE void write_subtree_velocities(float* sensordata) const {
  ROLLED_FOR(int s = 0; s < Model::SUBTREES; ++s) {
    float total[3] = {0.0f, 0.0f, 0.0f};
    const int end = Model::first_part(s + 1);
    ROLLED_FOR(int i = Model::first_part(s) + lane; i < end; i += LANES) {
      const int link = Model::part_link(i);
      const Pose pose = w.pose[link];
      const Vec offset = pose.position + pose.orientation * Model::part_center(i) - w.com[Model::tree(link)];
      const Motion velocity = w.velocity[link];
      const Vec v = velocity.at(offset);
      UNROLLED_FOR(int k = 0; k < 3; ++k) total[k] += Model::part_share(i) * v.component(k);
    }
    sum(total, 3);
    SHARED_LOOP(k, 3) sensordata[Model::subtree_address(s) + k] = k == 0 ? total[0] : k == 1 ? total[1] : total[2];
  }
}

// Angular momentum of a subtree about its centre of mass: that about the centre of its tree, less what its linear
// momentum at its own centre has about that.
INLINE void write_angular_momenta(float* sensordata) const {
  ROLLED_FOR(int s = 0; s < Model::MOMENTA; ++s) {
    Vec momentum = {0.0f, 0.0f, 0.0f}, linear = momentum, center = momentum;
    const int end = Model::first_momentum_part(s + 1);
    ROLLED_FOR(int i = Model::first_momentum_part(s) + lane; i < end; i += LANES) {
      const int link = Model::momentum_link(i);
      const Pose pose = w.pose[link];
      const Vec offset = pose.position + pose.orientation * Model::momentum_center(i) - w.com[Model::tree(link)];
      const Motion velocity = w.velocity[link];
      const float mass = Model::momentum_mass(i);
      const Vec push = velocity.at(offset) * mass;
      const Symmetric inertia = Model::momentum_inertia(i).turned(pose.orientation);
      momentum = momentum + inertia * velocity.angular + offset.cross(push);
      linear = linear + push;
      center = center + offset * mass;
    }
    float total[9] = {momentum.x, momentum.y, momentum.z, linear.x, linear.y, linear.z, center.x, center.y, center.z};
    sum(total, 9);
    const Vec about = Vec{total[6], total[7], total[8]} * Model::momentum_inverse_mass(s);
    const Vec found = Vec{total[0], total[1], total[2]} - about.cross({total[3], total[4], total[5]});
    SHARED_LOOP(k, 3) sensordata[Model::momentum_address(s) + k] = found.component(k);
  }
}
