// Contacts of spheres and capsules with boxes, in the frame of the box.

#if WITH_ROUND_AND_BOX || WITH_ROUND_ON_BOXES
struct Depth {
  float distance;
  Vec normal, point;
};

static INLINE Depth sphere_and_box(Vec center, float radius, Vec size) {
  const Vec inside = {clamp(center.x, -size.x, size.x), clamp(center.y, -size.y, size.y),
                      clamp(center.z, -size.z, size.z)};
  const Vec gap = inside - center;
  const float length = gap.norm();
  if (length > MINVAL) {
    const Vec normal = gap * divide(1.0f, length);
    return {length - radius, normal, (inside + center + normal * radius) * 0.5f};
  }
  float depth = 1e30f;  // the center is inside: out through the nearest face
  Vec normal;
  ROLLED_FOR(int face = 0; face < 6; ++face) {
    const float sign = face & 1 ? -1.0f : 1.0f, x = size.component(face / 2) + sign * center.component(face / 2);
    if (!(x < depth)) continue;
    depth = x;
    normal = {face / 2 == 0 ? sign : 0.0f, face / 2 == 1 ? sign : 0.0f, face / 2 == 2 ? sign : 0.0f};
  }
  return {-depth - radius, normal, center + normal * (0.5f * (radius - depth))};
}

static INLINE Vec from_axis(Vec v, int axis) {  // the same with its components in cyclic order
  return {v.component(axis), v.component(axis < 2 ? axis + 1 : 0), v.component(axis ? axis - 1 : 2)};
}

struct Ends {
  float first, second;
  int points;
};  // on a capsule's segment, in half axes from its center

// The point of a capsule's segment that is nearest to a box; and if the capsule lies along a face or an edge, the
// point up to which it does. The choices, and their order where several are as near, are MuJoCo's.
#if WITH_ROUND_AND_BOX && WITH_ROUND_ON_BOXES
static NOINLINE  // called twice
#else
static INLINE
#endif
    Ends capsule_and_box(Vec center, Vec half, Vec size) {
  const float length_squared = half.dot(half);
  float nearest = 1e30f, at = 0.0f, on_edge = 0.0f;
  int face = -1, edge = -1, side = 1, corner = 0;
  ROLLED_FOR(int end = 0; end < 2; ++end) {  // an end that is beyond one face, or inside
    const float sign = end ? 1.0f : -1.0f;
    const Vec tip = center + half * sign;
    const int beyond = (fabsf(tip.x) > size.x) | (fabsf(tip.y) > size.y) << 1 | (fabsf(tip.z) > size.z) << 2;
    if (beyond & (beyond - 1)) continue;
    const float x = beyond ? fabsf(tip.component(beyond / 2)) - size.component(beyond / 2) : 0.0f;
    if (!(x * x < nearest)) continue;
    nearest = x * x;
    at = sign;
    face = beyond ? beyond / 2 : -1;
  }
  ROLLED_FOR(int e = 0; e < 12; ++e) {  // a point between the ends, or the end of an edge
    const int axis = e / 4, below = (1 << axis) - 1, start = (e & 3 & below) | (e & 3 & ~below) << 1;
    const Vec h = from_axis(half, axis), s = from_axis(size, axis), c = from_axis(center, axis);
    const bool up = start >> (axis < 2 ? axis + 1 : 0) & 1, out = start >> (axis ? axis - 1 : 2) & 1;
    const Vec gap = {-c.x, (up ? s.y : -s.y) - c.y, (out ? s.z : -s.z) - c.z};
    const float across = h.y * h.y + h.z * h.z;
    if (s.x * s.x * across < MINVAL) continue;  // parallel
    float q = divide(h.y * gap.y + h.z * gap.z, across), p = divide(h.x * q - gap.x, s.x);
    int part = 1;  // of the edge: its start, between, or its end
    if (fabsf(p) > 1.0f) {
      part = p > 0.0f ? 2 : 0;
      p = p > 0.0f ? 1.0f : -1.0f;
      q = divide(h.dot(gap) + p * s.x * h.x, length_squared);
    }
    if (fabsf(q) > 1.0f) {
      q = q > 0.0f ? 1.0f : -1.0f;
      p = divide(q * h.x - gap.x, s.x);
      if (fabsf(p) > 1.0f) {
        part = p > 0.0f ? 2 : 0;
        p = p > 0.0f ? 1.0f : -1.0f;
      }
    }
    const Vec apart = gap - h * q + Vec{p * s.x, 0.0f, 0.0f};
    const float squared = apart.dot(apart);
    // Rounding does not decide: of points that are as near, the first counts, but a point within an edge before a
    // corner, which is never nearer than what is within its edges.
    const float least = part == 1 && side != 1 ? 1.00001f : 0.99999f;
    if (!(squared < nearest * least - MINVAL)) continue;
    nearest = squared;
    at = q;
    on_edge = p;
    edge = axis;
    side = part;
    corner = start | (part == 2) << axis;
  }

  const float level = 1e-6f * root(length_squared);  // what is aligned but for rounding does not rise
  const int rising = (half.x > level) | (half.y > level) << 1 | (half.z > level) << 2;
  const Ends one = {at, at, 1};
  float further, sign;
  if (edge < 0) {  // over a face
    if (face < 0) return one;
    sign = -at;
    further = 2.0f;
    ROLLED_FOR(int i = 0; i < 6; ++i) {
      const int axis = i / 2;
      const float h = half.component(axis), bound = i & 1 ? -size.component(axis) : size.component(axis);
      const float x = divide(bound - center.component(axis) - at * h, h) * sign;
      if (axis != face && x > 0.0f && x < further) further = x;
    }
  } else if (side != 1) {  // at a corner: along its edge, or across its face
    int apart = rising ^ corner;
    if (apart == 0 || apart == 7) return one;
    const bool two = apart & (apart - 1);
    if (two) apart = 7 - apart;
    sign = two ? -1.0f : 1.0f;
    const Vec h = from_axis(half, apart / 2), s = from_axis(size, apart / 2);
    if (h.x * h.x > 0.5f * length_squared) {
      further = smaller(divide(2.0f * s.x, fabsf(h.x)), 1.0f - sign * at);
    } else {
      further = smaller(divide(2.0f * s.y, fabsf(h.y)), 1.0f + sign * at);
      further = smaller(divide(2.0f * s.z, fabsf(h.z)), further);
      sign = -sign;
    }
  } else {  // across an edge: along the face to which the capsule is at a smaller angle
    const int next = edge < 2 ? edge + 1 : 0, last = edge ? edge - 1 : 2;
    const int apart = (rising ^ corner) & ~(1 << edge);
    if (apart == 0 || apart & (apart - 1)) return one;
    const Vec h = from_axis(half, edge), s = from_axis(size, edge);
    const bool along_next = fabsf(h.y) > fabsf(h.z), forward = apart >> (along_next ? next : last) & 1;
    sign = forward ? 1.0f : -1.0f;
    const float wide = along_next ? s.y : s.z, component = along_next ? h.y : h.z;
    further = smaller(divide(2.0f * wide, fabsf(component)), 1.0f - sign * at);
    const float left = (rising >> edge & 1) == forward ? 1.0f - on_edge : 1.0f + on_edge;
    further = smaller(divide(s.x * left, fabsf(h.x)), further);
  }
  return {at, at + sign * further, 2};
}

// Adds the contacts of the first geom of a pair with a box, numbered from `first` on, where `near`.
INLINE void touch_round_and_box(bool near, int pair, int first, Vec origin, const Mat& axes, Vec size,
                                const bool friction) {
  const Geom geom = w.geoms[Model::first_geom(pair)];
  const Vec center = axes.transposed_times(geom.center - origin), half = axes.transposed_times(geom.half_axis);
  const float reach = geom.radius + Model::margin(pair);
  // Bounding spheres of a trunk hold its legs. Most are clear of one of its faces, nearly all others along a normal of
  // an edge and the capsule, of length root(width). Rounding does not decide, as the exact test follows.
  UNROLLED_FOR(int i = 0; i < 3; ++i) {
    const int j = (i + 1) % 3, k = (i + 2) % 3;
    near = near && fabsf(center.component(i)) - fabsf(half.component(i)) < size.component(i) + reach;
    const float y = half.component(j), z = half.component(k), width = y * y + z * z;
    const float apart = fabsf(center.component(j) * z - center.component(k) * y) -
                        (size.component(j) * fabsf(z) + size.component(k) * fabsf(y));
    near = near && !(apart > 0.0f && apart * apart > 1.001f * reach * reach * width);
  }
  if (!ballot(near)) return;
  const Ends ends = half.dot(half) > MINVAL ? capsule_and_box(center, half, size) : Ends{0.0f, 0.0f, 1};
  ROLLED_FOR(int i = 0; i < 2; ++i) {
    const Depth depth = sphere_and_box(center + half * (i ? ends.second : ends.first), geom.radius, size);
    add_contact(near && i < ends.points && depth.distance < Model::margin(pair), friction, pair, first + i,
                origin + axes * depth.point, depth.distance, axes * depth.normal);
  }
}

#if WITH_ROUND_AND_BOX
INLINE void collide_round_and_box(const OwnPair own, const bool friction) {
  const int g = Model::second_geom(own.pair);
  touch_round_and_box(own.valid, own.pair, 0, w.geoms[g].center, geom_axes(g), Model::geom_size(g), friction);
}
#endif
#endif
