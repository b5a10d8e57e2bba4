// Contacts of spheres and capsules with height fields of the world. A field is a grid of cells of two triangular prisms
// each, from its base to its surface; as C MuJoCo has it, a contact for each of those that a geom touches.
struct FieldContacts : BoxPairContacts {
  using BoxPairContacts::BoxPairContacts;

#if WITH_ROUND_ON_FIELD
  // A geom in the frame of a field, from the field's corner, and the cells that it may touch.
  struct Over {
    Vec center, half, reach;
    int column, row, columns, rows;
    INLINE int prisms() const { return columns > 0 && rows > 0 ? 2 * columns * rows : 0; }
  };

  static INLINE int cell_of(float x, float cells) { return (int)clamp(x, 0.0f, cells); }

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
  static INLINE Touch apart_from(const Prism& p, Vec half) {
    float nearest = 1e30f;
    Vec on_prism, on_axis;
    ROLLED_FOR(int i = 0; i < 10; ++i) {
      const int face = i >> 1;
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
    ROLLED_FOR(int i = 0; i < 9; ++i) {
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
    return {length, gap * divide(1.0f, length), on_prism, on_axis};
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
      const Touch touch = crosses(p, o.half) ? out_of(p, o.half) : apart_from(p, o.half);
      const Geom geom = w.geoms[Model::second_geom(pair)];
      const float distance = touch.distance - geom.radius;
      const Mat axes = Model::field_orientation(field);
      const Vec point = (touch.on_prism + touch.on_axis - touch.normal * geom.radius) * 0.5f;
      const int cell = k >> 1, row = o.row + cell / o.columns, column = o.column + cell % o.columns;
      add_contact(valid && distance < Model::margin(pair), friction, pair, (row & 1) << 2 | (column & 1) << 1 | (k & 1),
                  geom.center + axes * point, distance, axes * touch.normal, {0.0f, 0.0f, 0.0f});
    }
  }

  INLINE void collide_round_on_field(const int, const int, const bool friction) {
    ROLLED_FOR(int field = 0; field < Model::FIELDS; ++field) {
      const int begin = Model::field_pair(4 * field + 2 * friction),
                end = Model::field_pair(4 * field + 2 * friction + 1);
      ROLLED_FOR(int base = begin; base < end; base += LANES) {
        const bool valid = base + lane < end;
        const int pair = valid ? base + lane : begin;
        const Over o = over(field, pair);
        const int prisms = valid ? o.prisms() : 0;
        int k = 0;
        while (ballot(k < prisms)) {  // lists prisms that reach up to the geoms, then looks at them
          int count = 0;
          while (ballot(k < prisms) && count <= Model::NEAR_GROUND - LANES) {
            float most = -1e30f;
            if (k < prisms) prism(field, o, k, most);
            const bool reaches = k < prisms && most >= o.center.z - o.reach.z;
            const unsigned hits = ballot(reaches);
            if (reaches) w.near_ground[count + bits(hits & lanes_below())] = (unsigned)pair << 16 | (unsigned)k;
            count += bits(hits);
            ++k;
          }
          sync();
          touch_prisms(field, count, friction);
          sync();
        }
      }
    }
  }
#endif
};
