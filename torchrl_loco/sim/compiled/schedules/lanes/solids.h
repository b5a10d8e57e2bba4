// Ellipsoids and cylinders, in their own frame, and contacts of spheres and capsules with them.

struct Surface {
  float distance;  // of a point, negative inside
  Vec normal;      // outwards, where the surface is nearest
};

// The nearest point q of an ellipsoid has a normal along m = q / size^2, and p - q = s m: m = p / (size^2 + s), where
// s makes |size m| = 1. From below, Newton's method on 1 / |size m| stays there. Near the plane through the longer axes
// no s does, and q lies off that plane by what is missing.
static INLINE Surface ellipsoid(Vec p, Vec size) {
  const Vec squared = {size.x * size.x, size.y * size.y, size.z * size.z};
  const float shortest = smaller(smaller(size.x, size.y), size.z), lowest = -0.9999f * shortest * shortest;
  float s = larger(larger(size.x * fabsf(p.x) - squared.x, size.y * fabsf(p.y) - squared.y),
                   larger(size.z * fabsf(p.z) - squared.z, lowest));
  Vec m, a;
  ROLLED_FOR(int i = 0; i < 16; ++i) {
    const Vec inverse = {divide(1.0f, squared.x + s), divide(1.0f, squared.y + s), divide(1.0f, squared.z + s)};
    m = {p.x * inverse.x, p.y * inverse.y, p.z * inverse.z};
    a = {size.x * m.x, size.y * m.y, size.z * m.z};
    const float length = a.norm();
    const float slope = a.x * a.x * inverse.x + a.y * a.y * inverse.y + a.z * a.z * inverse.z;
    if (i == 15 || fabsf(length - 1.0f) < 1e-6f || !(slope > 0.0f)) break;
    s = larger(s + divide(length * length * (length - 1.0f), slope), lowest);
  }
  if (a.dot(a) < 0.998f) {
    const int axis = size.x == shortest ? 0 : size.y == shortest ? 1 : 2;
    const float own = a.component(axis), missing = root(larger(1.0f - (a.dot(a) - own * own), 0.0f));
    const float along = divide(p.component(axis) < 0.0f ? -missing : missing, shortest);
    m = {axis == 0 ? along : m.x, axis == 1 ? along : m.y, axis == 2 ? along : m.z};
    const Vec out = Vec{squared.x * m.x, squared.y * m.y, squared.z * m.z} - p;
    return {-out.norm(), m * divide(1.0f, m.norm())};
  }
  const float length = m.norm();
  return {s * length, m * divide(1.0f, length)};
}

static INLINE Surface cylinder(Vec p, Vec size) {
  const float level = root(p.x * p.x + p.y * p.y), aside = level - size.x, above = fabsf(p.z) - size.y;
  const float inverse = level > MINVAL ? divide(1.0f, level) : 0.0f, up = p.z < 0.0f ? -1.0f : 1.0f;
  const Vec out = {level > MINVAL ? p.x * inverse : 1.0f, p.y * inverse, 0.0f};
  if (aside > 0.0f && above > 0.0f) {  // the rim
    const float distance = root(aside * aside + above * above), scale = divide(1.0f, distance);
    return {distance, out * (aside * scale) + Vec{0.0f, 0.0f, up * above * scale}};
  }
  if (aside > above) return {aside, out};
  return {above, {0.0f, 0.0f, up}};
}

static INLINE Surface surface(int shape, Vec p, Vec size) {
  return shape == ELLIPSOID ? ellipsoid(p, size) : cylinder(p, size);
}

// The point of a segment that is nearest to a solid, as a share of the half axis from the center: there the distance,
// which is convex outside, stops falling. By false position (Illinois).
static INLINE float nearest_on_segment(int shape, Vec size, Vec center, Vec half) {
  const auto slope_at = [&](const float t) { return surface(shape, center + half * t, size).normal.dot(half); };
  float low = -1.0f, high = 1.0f, low_slope = slope_at(low), high_slope = slope_at(high);
  if (!(low_slope < 0.0f)) return low;
  if (!(high_slope > 0.0f)) return high;
  const float flat = 1e-6f * half.norm();
  float t = 0.0f;
  int stays = 0;
  ROLLED_FOR(int i = 0; i < 24; ++i) {
    t = low - divide(low_slope * (high - low), high_slope - low_slope);
    const float slope = slope_at(t);
    if (fabsf(slope) < flat) break;
    if (slope < 0.0f) {
      low = t;
      low_slope = slope;
      high_slope *= stays == 1 ? 0.5f : 1.0f;
      stays = 1;
    } else {
      high = t;
      high_slope = slope;
      low_slope *= stays == -1 ? 0.5f : 1.0f;
      stays = -1;
    }
  }
  return t;
}

#if WITH_ROUND_AND_SOLID
// Where a capsule lies along a cap of a cylinder, at most 5 degrees off, both ends of what is above the cap touch it, as
// in C MuJoCo, to which the cap has 16 corners, and an end that it cuts off counts twice if the other one is clear.
struct OnCap {
  float first, second;  // on the lowest line of the capsule, in half axes from its middle
  int points;
};
static INLINE OnCap along_cap(Vec size, Vec middle, Vec half, float up, float margin) {
  float low = -1.0f, high = 1.0f;
  ROLLED_FOR(int side = 0; side < 16; ++side) {
    float sine, cosine;
    sincos((side + 0.5f) * 0.392699082f, sine, cosine);
    const float left = 0.980785280f * size.x - (cosine * middle.x + sine * middle.y);
    const float speed = cosine * half.x + sine * half.y, end = divide(left, speed);
    if (speed > 0.0f && end < high) high = end;
    if (speed < 0.0f && end > low) low = end;
    if (speed == 0.0f && left < 0.0f) high = -2.0f;
  }
  if (!(low <= high)) return {0.0f, 0.0f, 0};
  const bool low_is_in = up * (middle.z + low * half.z) - size.y <= 0.5f * margin;
  const bool high_is_in = up * (middle.z + high * half.z) - size.y <= 0.5f * margin;
  if (low_is_in && high_is_in) return {low, high, 2};
  if (low_is_in) return {low, low, low > -1.0f ? 2 : 1};
  return {high, high, !high_is_in ? 0 : high < 1.0f ? 2 : 1};
}

INLINE void collide_round_and_solid(const OwnPair own, const bool friction) {
  const int pair = own.pair, g = Model::second_geom(pair), shape = Model::geom_shape(g);
  const Geom geom = w.geoms[Model::first_geom(pair)];
  const Vec origin = w.geoms[g].center, size = Model::geom_size(g);
  const Mat axes = geom_axes(g);
  const Vec center = axes.transposed_times(geom.center - origin), half = axes.transposed_times(geom.half_axis);
  const float margin = Model::margin(pair), length = half.norm();
  const bool near = own.valid && surface(shape, center, size).distance - length < geom.radius + margin;
  if (!ballot(near)) return;
  const float t = near && length > 0.0f ? nearest_on_segment(shape, size, center, half) : 0.0f;
  const Surface nearest = surface(shape, center + half * t, size);
  const Vec out = nearest.normal, cap = {0.0f, 0.0f, out.z < 0.0f ? -1.0f : 1.0f};
  // The line that touches: the nearest point on the capsule, and as much of its axis as there is on both sides.
  const Vec axis = half * (length > 0.0f ? divide(1.0f, length) : 0.0f);
  const Vec middle = center - (out - axis * axis.dot(out)) * (geom.radius + 0.5f * margin);
  const bool lies = near && shape == CYLINDER && length > 0.0f && out.z != 0.0f && fabsf(axis.z) < 0.0887829f;
  const OnCap on_cap = lies ? along_cap(size, middle, half, cap.z, margin) : OnCap{0.0f, 0.0f, 0};
  ROLLED_FOR(int i = 0; i < 2; ++i) {
    const bool along = on_cap.points > 0;
    const Vec lowest =
        along ? middle + half * (i ? on_cap.second : on_cap.first) : center + half * t - out * geom.radius;
    const float distance = along ? cap.z * lowest.z - size.y + 0.5f * margin : nearest.distance - geom.radius;
    const Vec normal = (along ? cap : out) * -1.0f;
    add_contact(near && i < (along ? on_cap.points : 1) && distance < margin, friction, pair, i,
                origin + axes * (lowest + normal * (0.5f * distance - (along ? 0.5f * margin : 0.0f))), distance,
                axes * normal);
  }
}
#endif
