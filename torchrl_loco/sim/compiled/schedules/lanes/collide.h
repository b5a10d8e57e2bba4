// All contacts: those of each kind of pairs, and the touch sensors that feel them.

// Equalities are rows that lie before the contacts without friction. The slope is that of the second length's polynomial.
INLINE void hold_equalities() {
  ROLLED_FOR(int base = 0; base < Model::EQUALITIES; base += LANES) {
    const bool valid = base + lane < Model::EQUALITIES;
    const int i = valid ? base + lane : 0, end = Model::first_share(i + 1);
    float first = -Model::equality_reference(i), second = -Model::other_reference(i);
    ROLLED_FOR(int k = Model::first_share(i); k < end; ++k) {
      const float position = Model::share(k) * w.qpos[Model::dof_qpos(Model::share_dof(k))];
      if (Model::of_second(k)) second = second + position;
      else first = first + position;
    }
    float wanted = 0.0f, slope = 0.0f;
    UNROLLED_FOR(int power = 4; power >= 0; --power) {
      slope = wanted + second * slope;
      wanted = Model::polynomial(5 * i + power) + second * wanted;
    }
    add_contact(valid, false, Model::PAIRS + Model::BALL_LIMITS + i, 0, {0.0f, 0.0f, 0.0f}, first - wanted,
                {slope, 0.0f, 0.0f});
  }
}

INLINE void hold_welds() {
  ROLLED_FOR(int base = 0; base < Model::WELD_ROWS; base += LANES) {
    const bool valid = base + lane < Model::WELD_ROWS;
    const int i = valid ? base + lane : 0;
    const WeldRow row = weld_row(i);
    add_contact(valid, false, Model::FIRST_WELD + i, 0, row.point, row.distance, row.other);
  }
}

// The limit of a ball joint is a row along three degrees of freedom; it lies among the contacts without friction.
INLINE void limit_balls() {
  ROLLED_FOR(int base = 0; base < Model::BALL_LIMITS; base += LANES) {
    const bool valid = base + lane < Model::BALL_LIMITS;
    const int i = valid ? base + lane : 0, pair = Model::PAIRS + i;
    float angle;
    const Vec axis = qpos_quat(Model::ball_qpos(i)).axis(angle);
    const float distance = Model::ball_range(i) - angle;
    add_contact(valid && distance < Model::margin(pair), false, pair, 0, {0.0f, 0.0f, 0.0f}, distance, axis * -1.0f);
  }
}

// A touch sensor feels a contact of its body if the ray from the point along the normal, into the body, meets its
// site.
INLINE void feel_contacts() {
  SHARED_LOOP(i, frictional + frictionless) {
    const Contact c = contact(i);
    unsigned felt = 0;
    ROLLED_FOR(int s = 0; s < Model::TOUCH && c.pair() < Model::PAIRS; ++s) {
      const int body = Model::site_body(s);
      const bool first = body == Model::first_body(c.pair()), second = body == Model::second_body(c.pair());
      const Pose pose = pose_of(Model::site_link(s));
      const Mat site = Model::site_orientation(s);
      const Vec p = c.point + w.com[0] - pose.position;
      const Vec offset = pose.orientation.transposed_times(p) - Model::site_position(s);
      const Vec ray = pose.orientation.transposed_times(c.normal) * (second ? -1.0f : 1.0f);
      const Vec start = site.transposed_times(offset), along = site.transposed_times(ray);
      const bool meets = Interval::meets(Model::site_shape(s), Model::site_size(s), start, along);
      if ((first || second) && meets) felt |= 1u << s;
    }
    w.zones[place_of(i)] = felt;
  }
}

INLINE void find_contacts() {
  frictional = frictionless = 0;
  if (Model::GEOMS > 0) place_geoms();
#if WITH_ROUND_ON_FIELD || WITH_ROUND_ON_BOXES || WITH_BOX_ON_BOXES
  find_near_ground();
#endif
  const int count = Model::PAIRS > Model::PLANE_PAIRS ? near_pairs() : 0;
  int at = 0;  // in the list
  // Those with friction, then those without, by one text.
  ROLLED_FOR(int kind = 0; kind < 2; ++kind) {
    const bool friction = kind == 0;
    if (!friction) hold_equalities();
    if (!friction) hold_welds();
    if (!friction) limit_balls();
    //COLLIDE
  }
  sync();
  if (Model::TOUCH) feel_contacts();
  sync();
}
