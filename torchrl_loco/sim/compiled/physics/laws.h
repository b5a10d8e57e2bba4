// Laws of both schedules: where shapes touch, what constraint rows cost, and where a line search may end.

// ---- Contacts

struct Frame {  // of a contact
  // The normal along the gap of two segments. Where they cross but for rounding, it is across both, as in C MuJoCo.
  static INLINE Vec normal(Vec gap, Vec first, Vec second, float& length) {
    const Vec across = first.cross(second);
    const float width = across.norm(), aa = first.dot(first), bb = second.dot(second);
    length = gap.norm();
    const bool crossing = length * length <= 1e-10f * (aa + bb) && width * width > 1e-8f * aa * bb;
    const float size = crossing ? width : length;
    return size > 0.0f ? (crossing ? across : gap) * Math::divide(1.0f, size) : Vec{1.0f, 0.0f, 0.0f};
  }
  // A tangent; the other one is normal x tangent.
  static INLINE Vec tangent(Vec normal) {
    const bool steep = fabsf(normal.y) < 0.5f;
    const Vec axis = {0.0f, steep ? 1.0f : 0.0f, steep ? 0.0f : 1.0f}, level = axis - normal * normal.dot(axis);
    return level * Math::divide(1.0f, level.norm());
  }
  // The tangent that follows a hint, unless that is nearly normal, or nothing.
  static INLINE Vec tangent(Vec normal, Vec hint, float least) {
    const Vec along = hint - normal * normal.dot(hint);
    const float length = along.norm();
    return length < least ? tangent(normal) : along * Math::divide(1.0f, length);
  }
};

struct Segment {
  Vec start, along;
  INLINE Vec at(float share) const { return start + along * share; }
};

// The nearest points of two segments, as shares of their lengths from the start: one pair, or two of parallel segments.
// (The ends of each overlap, and points instead of segments, are cases of their own.)
struct Nearest {
  float first[2], second[2];
  int points;
  static INLINE Nearest of(Segment a, Segment b) {
    const Vec between = a.start - b.start;
    const float aa = a.along.dot(a.along), bb = b.along.dot(b.along), ab = a.along.dot(b.along);
    const float a_between = a.along.dot(between), b_between = b.along.dot(between);
    const Vec across = a.along.cross(b.along);
    const float determinant = across.dot(across);
    Nearest nearest = {{0.0f, 0.0f}, {0.0f, 0.0f}, 1};
    if (aa <= MINVAL || bb <= MINVAL) {  // a sphere
      if (bb > MINVAL) nearest.second[0] = Math::clamp(Math::divide(b_between, bb), 0.0f, 1.0f);
      else if (aa > MINVAL) nearest.first[0] = Math::clamp(Math::divide(-a_between, aa), 0.0f, 1.0f);
      return nearest;
    }
    // The points of a that are nearest to the start and to the end of b.
    const float to_start = Math::clamp(Math::divide(-a_between, aa), 0.0f, 1.0f);
    const float to_end = Math::clamp(Math::divide(ab - a_between, aa), 0.0f, 1.0f);
    const bool parallel = determinant <= 1e-8f * aa * bb;
    const float crossing = Math::divide(across.dot(b.along.cross(between)), determinant);
    float share = parallel ? 0.0f : Math::clamp(crossing, 0.0f, 1.0f);
    UNROLLED_FOR(int i = 0; i < 2; ++i) {  // parallel segments may touch at both ends
      const float other = Math::divide(ab * share + b_between, bb);
      nearest.first[i] = other < 0.0f ? to_start : other > 1.0f ? to_end : share;
      nearest.second[i] = Math::clamp(other, 0.0f, 1.0f);
      share = 1.0f;
    }
    if (parallel) nearest.points = 2;
    return nearest;
  }
};

// ---- Sites

enum Shape { SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, MESH };  // of geoms and of sites

struct Interval {  // of a ray's parameter: the part that lies in a convex shape
  float from, to;
  INLINE Interval both(Interval b) const { return {Math::larger(from, b.from), Math::smaller(to, b.to)}; }
  INLINE bool ahead() const { return from <= to && to >= 0.0f; }
  // Where a t^2 + 2 b t + c <= 0.
  static INLINE Interval quadratic(float a, float b, float c) {
    const float discriminant = b * b - a * c;
    if (a < MINVAL) return {c <= 0.0f ? -1e30f : 1e30f, c <= 0.0f ? 1e30f : -1e30f};
    if (discriminant < 0.0f) return {1e30f, -1e30f};
    const float r = Math::root(discriminant);
    return {Math::divide(-b - r, a), Math::divide(-b + r, a)};
  }
  static INLINE Interval sphere(Vec p, Vec v, float radius) {
    return quadratic(v.dot(v), p.dot(v), p.dot(p) - radius * radius);
  }
  static INLINE Interval cylinder(Vec p, Vec v, float radius) {
    return sphere({p.x, p.y, 0.0f}, {v.x, v.y, 0.0f}, radius);
  }
  static INLINE Interval slab(float p, float v, float half) { return quadratic(v * v, p * v, p * p - half * half); }

  // Whether a ray from p along v, in the frame of a site, meets the site.
  static INLINE bool meets(int shape, Vec size, Vec p, Vec v) {
    const Interval along_z = slab(p.z, v.z, shape == BOX ? size.z : size.y);
    if (shape == BOX) return along_z.both(slab(p.x, v.x, size.x)).both(slab(p.y, v.y, size.y)).ahead();
    if (shape == CYLINDER) return along_z.both(cylinder(p, v, size.x)).ahead();
    if (shape == CAPSULE) {
      const Vec end = {0.0f, 0.0f, size.y};
      return along_z.both(cylinder(p, v, size.x)).ahead() || sphere(p - end, v, size.x).ahead() ||
             sphere(p + end, v, size.x).ahead();
    }
    // An ellipsoid, squeezed to a unit sphere.
    const Vec inverse = {Math::divide(1.0f, size.x), Math::divide(1.0f, size.y), Math::divide(1.0f, size.z)};
    const Vec q = {p.x * inverse.x, p.y * inverse.y, p.z * inverse.z};
    return sphere(q, {v.x * inverse.x, v.y * inverse.y, v.z * inverse.z}, 1.0f).ahead();
  }
};

// ---- Constraint rows. A row has a residual x and a weight D, and v is how x changes along the search direction. What a
// step of alpha changes of its cost, and slope and curvature there (its bend), are added to three sums. The change is no
// difference of costs where the row stays on its side: beside what a deep contact costs, a number has no room for what
// is gained. Minima and maxima, not conditions: what a predicate guards waits 13 cycles for it on a GPU.

struct OneSided {  // costs D x^2 / 2 where x < 0
  static INLINE float gradient(float x, float weight) { return weight * Math::smaller(x, 0.0f); }
  static INLINE float curvature(float x, float weight) { return x < 0.0f ? weight : 0.0f; }
};

struct DryFriction {  // costs D x^2 / 2 while |x| is below a bound, and grows linearly beyond
  static INLINE float gradient(float x, float weight, float bound) { return weight * Math::clamp(x, -bound, bound); }
  static INLINE float curvature(float x, float weight, float bound) { return fabsf(x) < bound ? weight : 0.0f; }
  static INLINE bool crosses(float x, float next, float bound) {
    return bound > 0.0f && ((x < bound) != (next < bound) || (x > -bound) != (next > -bound));
  }
};

struct ConstraintRow {  // of either kind, along a search direction
  float x, v, weight, bound;
  bool dry;  // or one-sided, without a bound
  INLINE float after(float alpha) const { return x + alpha * v; }
  INLINE bool crosses(float next) const {
    return dry ? DryFriction::crosses(x, next, bound) : (x < 0.0f) != (next < 0.0f);
  }
  INLINE float cost_at(float y) const {
    if (dry) return fabsf(y) < bound ? 0.5f * weight * y * y : weight * bound * (fabsf(y) - 0.5f * bound);
    return y < 0.0f ? 0.5f * weight * y * y : 0.0f;
  }
  INLINE float cost() const { return cost_at(x); }
  INLINE float change(float alpha) const {
    if (dry) {
      const float y = fmaf(alpha, v, x);
      const bool inside = fabsf(y) < bound && fabsf(x) < bound;
      return inside ? 0.5f * weight * (x + y) * (alpha * v) : cost_at(y) - cost_at(x);
    }
    const float out = Math::larger(x, 0.0f), in = Math::larger(-x, 0.0f);
    const float moved = Math::smaller(fmaf(alpha, v, out), in);
    return weight * moved * fmaf(0.5f, moved, -in);
  }
  INLINE void bend(float alpha, float* sums) const {
    const float y = fmaf(alpha, v, x);
    if (dry) {
      sums[0] += weight * v * Math::clamp(y, -bound, bound);
      sums[1] += fabsf(y) < bound ? weight * v * v : 0.0f;
      return;
    }
    sums[0] = fmaf(weight * v, Math::smaller(y, 0.0f), sums[0]);
    sums[1] = fmaf(y < 0.0f ? 1.0f : 0.0f, weight * v * v, sums[1]);
  }
  INLINE void add(float alpha, float* sums) const {
    sums[0] += change(alpha);
    bend(alpha, sums + 1);
  }
};

// ---- The line search. Brackets and tolerances are those of mujoco_warp, but for what saves evaluations: the first
// bracket tries the secant, where iterations are many, a search may end near its minimum, and a thread that has a world
// to itself tries one step at a time.

// Conditions are joined by | and &: by || and &&, each would be a branch.

struct Point {  // on the search direction: the cost relative to alpha = 0
  float alpha, cost, slope, curvature;
  // Where the rows add three sums to a quadratic form with a slope and a curvature at alpha = 0.
  static INLINE Point at(float alpha, float slope, float curvature, const float* sums) {
    const float cost = alpha * slope + 0.5f * alpha * alpha * curvature + sums[0];
    return {alpha, cost, slope + alpha * curvature + sums[1], curvature + sums[2]};
  }
  INLINE float newton() const { return curvature == 0.0f ? alpha : alpha - Math::divide(slope, curvature); }
  // Where the line through two slopes is zero.
  INLINE float secant(const Point& p) const {
    return slope == p.slope ? alpha : alpha - Math::divide(slope * (p.alpha - alpha), p.slope - slope);
  }
  // Whether this improves on alpha = 0 and is nearly a minimum.
  INLINE bool flat(float tolerance) const { return (fabsf(slope) < tolerance) & (cost < 0.0f); }
  // Whether a search may end here. Near the minimum is enough, if most is gained: the next direction gains the rest, and
  // close to the solution the first point is a Newton step of the whole.
  INLINE bool ends(const Point& start, float tolerance, float near) const {
    const float whole = fabsf(start.slope);  // twice what a parabola gains
    return flat(tolerance) | ((fabsf(slope) < near * whole) & (cost < -0.05f * whole));
  }
  // Whether p lies between this and the minimum: its slope has the same sign, and is smaller.
  INLINE bool outside(const Point& p) const {
    return ((slope < p.slope) & (p.slope < 0.0f)) | ((slope > p.slope) & (p.slope > 0.0f));
  }
  INLINE bool move(const Point& p, bool wanted) {
    if (wanted) *this = p;
    return wanted;
  }
};

struct Search {  // the result of a line search
  float alpha, improvement, slope;
  INLINE void take(const Point& p, bool acceptable) {
    const bool better = acceptable & (-p.cost > improvement);  // which what is no number is not
    alpha = better ? p.alpha : alpha;
    improvement = better ? -p.cost : improvement;
    slope = better ? p.slope : slope;
  }
};
