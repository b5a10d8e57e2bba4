// Contacts of spheres and capsules.

// Spheres and capsules against each other: the nearest points of the two segments.
INLINE void collide_round_and_round(const OwnPair own, const bool friction) {
  const int pair = own.pair;
  const Geom a = w.geoms[Model::first_geom(pair)], b = w.geoms[Model::second_geom(pair)];
  const Segment first = {a.center - a.half_axis, a.half_axis * 2.0f};
  const Segment second = {b.center - b.half_axis, b.half_axis * 2.0f};
  const Nearest nearest = Nearest::of(first, second);
  ROLLED_FOR(int i = 0; i < 2; ++i) {
    const Vec point = first.at(i ? nearest.first[1] : nearest.first[0]);
    const Vec gap = second.at(i ? nearest.second[1] : nearest.second[0]) - point;
    float length;
    const Vec normal = Frame::normal(gap, first.along, second.along, length);
    const float distance = length - (a.radius + b.radius);
    add_contact(own.valid && i < nearest.points && distance < Model::margin(pair), friction, pair, i,
                point + normal * (a.radius + 0.5f * distance), distance, normal);
  }
}
