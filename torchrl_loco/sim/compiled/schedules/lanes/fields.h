// Contacts of spheres and capsules with height fields of the world. A field is a grid of cells of two triangular prisms
// each, from its base to its surface; as C MuJoCo has it, a contact for each of those that a geom touches.

#if WITH_ROUND_ON_FIELD || WITH_ROUND_ON_BOXES || WITH_BOX_ON_BOXES
static INLINE int cell_of(float x, float cells) { return (int)clamp(x, 0.0f, cells); }

unsigned lane_near;  // a bit for each geom of this lane: whether it is near the ground

// Whether a geom is near the ground, by a table of the greatest heights around; a large one always is.
INLINE bool reaches_down(int g) const {
  const Geom geom = w.geoms[g];
  const Vec center = geom.center + w.com[0];
  const float r = geom.radius + Model::ground_margin();
  if (!(fabsf(center.x) + fabsf(center.y) < 1e30f)) return false;  // what is not finite is nowhere
  if (larger(fabsf(geom.half_axis.x), fabsf(geom.half_axis.y)) + r > Model::tops_cell()) return true;
  const float x = divide(center.x - Model::tops_x(), Model::tops_cell());
  const float y = divide(center.y - Model::tops_y(), Model::tops_cell());
  const int column = cell_of(x, Model::TOPS_COLUMNS - 1), row = cell_of(y, Model::TOPS_ROWS - 1);
  return center.z - fabsf(geom.half_axis.z) - r <= terrain[Model::TOPS + row * Model::TOPS_COLUMNS + column];
}
INLINE void find_near_ground() {
  lane_near = 0;
  if (LANES > 1)
    ROLLED_FOR(int g = lane; g < Model::GEOMS; g += LANES)
      if (reaches_down(g)) lane_near |= 1u << g / LANES;
}
INLINE bool is_near_ground(int g) const {  // for all lanes together
  return LANES > 1 ? read(lane_near, g % LANES) >> g / LANES & 1 : reaches_down(g);
}

// Of a pair with the ground; round geoms come before boxes of the ground, the others behind them.
static INLINE int moving(const bool first, int pair) {
  return first ? Model::first_geom(pair) : Model::second_geom(pair);
}

// Lists the pairs from one to another that have a geom near the ground, and returns how many there are.
INLINE int list_near(const bool first, const int begin, const int end) {
  int count = 0;
  ROLLED_FOR(int base = begin; base < end; base += LANES) {
    const OwnPair own = own_pair(base, end);
    const bool near = is_near_ground(moving(first, own.pair)) && own.valid;
    const unsigned hits = ballot(near);
    if (near) w.near_pairs[count + bits(hits & lanes_below())] = (unsigned short)own.pair;
    count += bits(hits);
  }
  sync();
  return count;
}
#endif

#if WITH_ROUND_ON_FIELD
// A geom in the frame of a field, from the field's corner, and the cells that it may touch.
struct Over {
  Vec center, half, reach;
  int column, row, columns, rows;
  INLINE int prisms() const { return columns > 0 && rows > 0 ? 2 * columns * rows : 0; }
};

INLINE Over over(int field, int pair) const {
  const Geom geom = w.geoms[Model::second_geom(pair)];
  const Mat axes = Model::field_orientation(field);
  const float dx = Model::cell_width(field), dy = Model::cell_height(field);
  const float columns = Model::field_columns(field), rows = Model::field_rows(field);
  const float r = geom.radius + Model::margin(pair);
  Over o;
  o.center = axes.transposed_times(geom.center + w.com[0] - Model::field_corner(field));
  o.half = axes.transposed_times(geom.half_axis);
  o.reach = {fabsf(o.half.x) + r, fabsf(o.half.y) + r, fabsf(o.half.z) + r};
  o.column = cell_of(floorf(divide(o.center.x - o.reach.x, dx)), columns);
  o.row = cell_of(floorf(divide(o.center.y - o.reach.y, dy)), rows);
  o.columns = cell_of(ceilf(divide(o.center.x + o.reach.x, dx)), columns) - o.column;
  o.rows = cell_of(ceilf(divide(o.center.y + o.reach.y, dy)), rows) - o.row;
  const bool apart =
      o.center.z - o.reach.z > Model::field_top(field) || o.center.z + o.reach.z < -Model::field_base(field);
  if (apart || o.center.x + o.reach.x < 0.0f || o.center.y + o.reach.y < 0.0f ||
      o.center.x - o.reach.x > columns * dx || o.center.y - o.reach.y > rows * dy)
    o.columns = 0;
  return o;
}

// A prism from the center of a geom: its upper corners, the normals of its faces (upper, lower, and at the sides from
// each corner to the next), and the height of its base.
struct Prism {
  Vec a, b, c, upper, of_ab, of_bc, of_ca;
  float low;
  INLINE Vec top(int i) const { return i == 0 ? a : i == 1 ? b : c; }
  INLINE Vec corner(int i) const {
    const Vec v = top(i < 3 ? i : i - 3);
    return i < 3 ? v : Vec{v.x, v.y, low};
  }
  INLINE Vec normal(int face) const {
    return face == 0 ? upper : face == 1 ? Vec{0.0f, 0.0f, -1.0f} : face == 2 ? of_ab : face == 3 ? of_bc : of_ca;
  }
  INLINE float offset(int face) const { return face == 1 ? -low : normal(face).dot(face == 0 ? a : top(face - 2)); }
  // Edges: those of the surface, those of the base, the upright ones.
  INLINE Segment edge(int i) const {
    const int k = i % 3, next = k == 2 ? 0 : k + 1;
    const Vec start = corner(i < 6 ? (i < 3 ? k : k + 3) : k), end = corner(i < 3 ? next : i < 6 ? next + 3 : k + 3);
    return {start, end - start};
  }
};

INLINE float height(int field, int row, int column) const {
  return terrain[Model::field_data(field) + row * ((int)Model::field_columns(field) + 1) + column];
}

// Number k of the prisms of the cells; `most` is the height of its highest corner in the frame of the field.
INLINE Prism prism(int field, const Over& o, int k, float& most) const {
  const int cell = k >> 1, row = o.row + cell / o.columns, column = o.column + cell % o.columns;
  const bool lower = k & 1;
  const float dx = Model::cell_width(field), dy = Model::cell_height(field);
  const float x = dx * (float)column - o.center.x, y = dy * (float)row - o.center.y;
  const float first = height(field, row, column), last = height(field, row + 1, column + 1);
  const float between = lower ? height(field, row, column + 1) : height(field, row + 1, column);
  most = larger(first, larger(last, between));
  const float diagonal = divide(1.0f, root(dx * dx + dy * dy));
  const Vec start = {x, y, first - o.center.z}, end = {x + dx, y + dy, last - o.center.z};
  const Vec other = {lower ? x + dx : x, lower ? y : y + dy, between - o.center.z};
  Prism p;
  p.a = start;
  p.b = lower ? other : end;
  p.c = lower ? end : other;
  const Vec across = (p.b - p.a).cross(p.c - p.a);
  p.upper = across * divide(1.0f, across.norm());
  const Vec along_x = {0.0f, lower ? -1.0f : 1.0f, 0.0f}, along_y = {lower ? 1.0f : -1.0f, 0.0f, 0.0f};
  const Vec slanted = Vec{lower ? -dy : dy, lower ? dx : -dx, 0.0f} * diagonal;
  p.of_ab = lower ? along_x : slanted;
  p.of_bc = lower ? along_y : along_x;
  p.of_ca = lower ? slanted : along_y;
  p.low = -Model::field_base(field) - o.center.z;
  return p;
}

// Where an axis through the origin touches a prism: the distance, the normal out of the prism, and the points of both.
struct Touch {
  float distance;
  Vec normal, on_prism, on_axis;
};

// How far an axis through the origin is outside of the plane of a face.
static INLINE float above(const Prism& p, int face, Vec half) {
  return -p.offset(face) - fabsf(p.normal(face).dot(half));
}

// Whether the lower end of an axis is over the upper face: then it is nearest.
static INLINE bool lands(const Prism& p, Vec half, Touch& touch) {
  const Vec end = half * (p.upper.dot(half) > 0.0f ? -1.0f : 1.0f);
  const float height = p.upper.dot(end) - p.offset(0);
  const Vec foot = end - p.upper * height;
  touch = {height, p.upper, foot, end};
  bool inside = height > 0.0f;
  ROLLED_FOR(int k = 2; k < 5; ++k) inside = inside && p.normal(k).dot(foot) <= p.offset(k);
  return inside;
}

static INLINE bool crosses(const Prism& p, Vec half) {
  float from = -1.0f, to = 1.0f;
  ROLLED_FOR(int face = 0; face < 5; ++face) {
    const float above = -p.offset(face), rise = p.normal(face).dot(half);
    if (fabsf(rise) < MINVAL) {
      if (above > 0.0f) to = -2.0f;
    } else {
      const float at = divide(-above, rise);
      if (rise > 0.0f) to = smaller(to, at);
      else from = larger(from, at);
    }
  }
  return from <= to;
}

// Outside: the nearest points, of the ends and a face, or of the axis and an edge.
static INLINE Touch apart_from(const Prism& p, Vec half, bool is_over) {
  const bool is_low = -fabsf(half.z) <= p.low;  // else the base is farther than what is above it
  float nearest = 1e30f;
  Vec on_prism, on_axis;
  ROLLED_FOR(int i = is_over ? 10 : 0; i < 10; ++i) {
    const int face = i >> 1;
    if (face == 1 && !is_low) continue;
    const Vec end = half * (i & 1 ? -1.0f : 1.0f), normal = p.normal(face);
    const float above = normal.dot(end) - p.offset(face);
    if (!(above > 0.0f) || !(above * above < nearest)) continue;
    const Vec foot = end - normal * above;
    bool inside = true;
    ROLLED_FOR(int k = 0; k < 5; ++k) inside = inside && (k == face || p.normal(k).dot(foot) <= p.offset(k));
    if (!inside) continue;
    nearest = above * above;
    on_prism = foot;
    on_axis = end;
  }
  const Segment axis = {half * -1.0f, half * 2.0f};
  ROLLED_FOR(int i = 0; i < (is_over ? 3 : 9); ++i) {
    if (i / 3 == 1 && !is_low) continue;
    const Segment edge = p.edge(i);
    const Nearest points = Nearest::of(axis, edge);
    const Vec of_axis = axis.at(points.first[0]), of_edge = edge.at(points.second[0]), gap = of_axis - of_edge;
    if (!(gap.dot(gap) < nearest)) continue;
    nearest = gap.dot(gap);
    on_prism = of_edge;
    on_axis = of_axis;
  }
  const Vec gap = on_axis - on_prism;
  const float length = gap.norm();
  return {length, length < MINVAL ? p.upper : gap * divide(1.0f, length), on_prism, on_axis};
}

// The same of the origin alone, which is over the base but not over the upper face.
static INLINE Touch of_point(const Prism& p, bool is_over) {
  float nearest = 1e30f;
  Vec on_prism, out;
  bool inside = true;
  ROLLED_FOR(int face = 0; face < 5; ++face) {
    const float depth = p.offset(face);
    inside = inside && depth >= 0.0f;
    if (!(depth < nearest)) continue;
    nearest = depth;
    out = p.normal(face);
  }
  if (inside) return {-nearest, out, out * nearest, {0.0f, 0.0f, 0.0f}};
  nearest = 1e30f;
  ROLLED_FOR(int i = 0; i < (is_over ? 3 : 6); ++i) {  // on an edge of the upper face, then on a side below it
    const Vec start = p.top(i % 3), along = p.top(i % 3 == 2 ? 0 : i % 3 + 1) - start;
    const float up = i < 3 ? 1.0f : 0.0f;
    const float across = along.x * start.x + along.y * start.y + up * along.z * start.z;
    const float squared = along.x * along.x + along.y * along.y + up * along.z * along.z;
    Vec at = start + along * clamp(divide(-across, squared), 0.0f, 1.0f);
    if (i >= 3) at.z = smaller(at.z, 0.0f);
    if (!(at.dot(at) < nearest)) continue;
    nearest = at.dot(at);
    on_prism = at;
  }
  const float length = root(nearest);
  return {length, length < MINVAL ? p.upper : on_prism * divide(-1.0f, length), on_prism, {0.0f, 0.0f, 0.0f}};
}

// Inside: out by the least depth, through a face or past an edge.
static INLINE Touch out_of(const Prism& p, Vec half) {
  float depth = 1e30f;
  Vec normal;
  int past = -1;
  ROLLED_FOR(int face = 0; face < 5; ++face) {
    const Vec n = p.normal(face);
    const float x = p.offset(face) + fabsf(n.dot(half));
    if (!(x < depth)) continue;
    depth = x;
    normal = n;
  }
  ROLLED_FOR(int i = 0; i < 18; ++i) {
    const Segment edge = p.edge(i >> 1);
    const Vec across = edge.along.cross(half) * (i & 1 ? -1.0f : 1.0f);
    const float squared = across.dot(across);
    if (squared < 1e-10f * edge.along.dot(edge.along) * half.dot(half) || squared < MINVAL) continue;  // parallel
    const Vec n = across * divide(1.0f, root(squared));
    const float own = n.dot(edge.start);
    float most = own;
    ROLLED_FOR(int k = 0; k < 6; ++k) most = larger(most, n.dot(p.corner(k)));
    // Rounding does not choose an edge where a face is as near.
    if (most - own > 1e-6f || !(most < depth - 1e-6f)) continue;
    depth = most;
    normal = n;
    past = i >> 1;
  }
  if (past < 0) {
    const float rise = normal.dot(half);
    const Vec end = half * (fabsf(rise) < 1e-7f ? 0.0f : rise > 0.0f ? -1.0f : 1.0f);
    return {-depth, normal, end + normal * depth, end};
  }
  const Segment axis = {half * -1.0f, half * 2.0f}, edge = p.edge(past);
  const Nearest points = Nearest::of(axis, edge);
  return {-depth, normal, edge.at(points.second[0]), axis.at(points.first[0])};
}

INLINE void touch_prisms(int field, const int count, const bool friction) {
  ROLLED_FOR(int base = 0; base < count; base += LANES) {
    const bool valid = base + lane < count;
    const unsigned entry = w.near_ground[valid ? base + lane : 0];
    const int pair = entry >> 16, k = entry & 0xffff;
    const Over o = over(field, pair);
    float most;
    const Prism p = prism(field, o, k, most);
    Touch touch;
    const bool landed = lands(p, o.half, touch);
    const bool is_point = o.half.dot(o.half) < MINVAL && p.low < 0.0f;
    // What is as high as all of its corners is nearest to an edge of the upper face, if not to that.
    const bool is_over = o.center.z - fabsf(o.half.z) >= most;
    if (!landed && is_point) touch = of_point(p, is_over);
    if (!landed && !is_point) {
      const bool inside = !is_over && crosses(p, o.half);
      touch = inside ? out_of(p, o.half) : apart_from(p, o.half, is_over);
    }
    const Geom geom = w.geoms[Model::second_geom(pair)];
    const float distance = touch.distance - geom.radius;
    const Mat axes = Model::field_orientation(field);
    const Vec point = (touch.on_prism + touch.on_axis - touch.normal * geom.radius) * 0.5f;
    const int cell = k >> 1, row = o.row + cell / o.columns, column = o.column + cell % o.columns;
    add_contact(valid && distance < Model::margin(pair), friction, pair, (row & 1) << 2 | (column & 1) << 1 | (k & 1),
                geom.center + axes * point, distance, axes * touch.normal);
  }
}

// Whether a geom may touch number k of the prisms below it, by the planes of its upper and its slanted face.
INLINE bool reaches(int field, int pair, int k) const {
  const Over o = over(field, pair);
  float most;
  const Prism p = prism(field, o, k, most);
  const int slanted = k & 1 ? 4 : 2;
  const float r = w.geoms[Model::second_geom(pair)].radius + Model::margin(pair) + 1e-6f;
  return most >= o.center.z - o.reach.z && above(p, 0, o.half) <= r && above(p, slanted, o.half) <= r;
}

INLINE void collide_round_on_field(const bool friction) {
  ROLLED_FOR(int field = 0; field < Model::FIELDS; ++field) {
    const int begin = Model::field_pair(4 * field + 2 * friction),
              end = Model::field_pair(4 * field + 2 * friction + 1);
    const int listed = list_near(false, begin, end);
    // Lists prisms that geoms may touch, and looks at them together when the list is full, and at last.
    int count = 0, base = -LANES, before = 0, all = 0, next = 0;
    ROLLED_FOR(bool is_last = listed == 0; !is_last;) {
      if (next >= all) {
        base += LANES;
        is_last = base >= listed;
        all = next = 0;
        if (!is_last) {
          const int prisms = base + lane < listed ? over(field, w.near_pairs[base + lane]).prisms() : 0;
          before = sum_below(prisms);
          all = read(before + prisms, LANES - 1);
        }
      }
      if (next < all) {
        const Item item = dealt(before, all, next + lane);
        const int own = item.exists ? w.near_pairs[base + item.owner] : begin, k = item.exists ? item.number : 0;
        const bool near = item.exists && reaches(field, own, k);
        const unsigned hits = ballot(near);
        if (near) w.near_ground[count + bits(hits & lanes_below())] = (unsigned)own << 16 | (unsigned)k;
        count += bits(hits);
        next += LANES;
      }
      if (count > (is_last ? 0 : Model::NEAR_GROUND - LANES)) {
        sync();
        touch_prisms(field, count, friction);
        sync();
        count = 0;
      }
    }
  }
}
#endif
