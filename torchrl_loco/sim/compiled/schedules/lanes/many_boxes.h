// Contacts with the boxes of the world, if they are many: a grid of cells names those that a geom may touch.

#if WITH_ROUND_ON_BOXES || WITH_BOX_ON_BOXES
// A box, as ground.py has it.
struct GroundBox {
  const float* const data;
  INLINE Vec at(int i) const { return {data[i], data[i + 1], data[i + 2]}; }
  INLINE Vec low() const { return at(0); }
  INLINE Vec high() const { return at(3); }
  INLINE Vec center() const { return at(6); }
  INLINE Mat axes() const { return {at(9), at(12), at(15)}; }
  INLINE Vec size() const { return at(18); }
  INLINE int kind() const { return (int)data[21]; }
  INLINE int column() const { return (int)data[22]; }
  INLINE int row() const { return (int)data[23]; }
};
INLINE GroundBox ground_box(int i) const { return {terrain + Model::BOXES + (size_t)i * Model::BOX_NUMBERS}; }
// The boxes of a cell are named from one of these to the next.
INLINE int first_named(int cell) const { return reinterpret_cast<const int*>(terrain)[Model::CELLS + cell]; }
INLINE int named(int i) const { return reinterpret_cast<const int*>(terrain)[Model::NAMED + i]; }

static INLINE int cell_along(float x, float corner, int cells) {
  return (int)clamp(floorf(divide(x - corner, Model::grid_cell())), 0.0f, (float)(cells - 1));
}

// How far a geom that is no box, or is one, reaches from its center along the axes of the world.
INLINE Vec reach_of(const bool round, int pair) const {
  const int g = moving(round, pair);
  const float margin = Model::margin(pair);
  const Geom geom = w.geoms[g];
  Vec reach = {fabsf(geom.half_axis.x), fabsf(geom.half_axis.y), fabsf(geom.half_axis.z)};
  float more = geom.radius + margin;
#if WITH_BOX_ON_BOXES
  if (!round) {
    const Mat axes = geom_axes(g);
    const Vec size = Model::geom_size(g);
    reach = {magnitude(axes.row0).dot(size), magnitude(axes.row1).dot(size), magnitude(axes.row2).dot(size)};
    more = margin;
  }
#endif
  return reach + Vec{more, more, more};
}

INLINE void touch_ground_boxes(const bool round, const int first, const int count, const bool friction) {
  ROLLED_FOR(int base = 0; base < count; base += LANES) {
    const bool valid = base + lane < count;
    const unsigned entry = w.near_ground[valid ? base + lane : 0];
    const int pair = first + (int)(entry >> 24), i = entry & 0xffffff;
    const GroundBox box = ground_box(i);
    const Vec origin = box.center() - w.com[0];
#if WITH_ROUND_ON_BOXES
    if (round) touch_round_and_box(valid, pair, 2 * (i & 3), origin, box.axes(), box.size(), friction);
#endif
#if WITH_BOX_ON_BOXES
    if (!round) touch_box_and_box(valid, pair, origin, box.axes(), box.size(), friction);
#endif
  }
}

// The bounds of a geom in the world, and the cells that it may touch.
struct Bounds {
  Vec low, high;
  int column, row, columns, rows;
};
INLINE Bounds bounds_of(const bool round, int pair) const {
  Bounds b;
  const Vec center = w.geoms[moving(round, pair)].center + w.com[0], reach = reach_of(round, pair);
  b.low = center - reach;
  b.high = center + reach;
  b.column = cell_along(b.low.x, Model::grid_x(), Model::GRID_COLUMNS);
  b.row = cell_along(b.low.y, Model::grid_y(), Model::GRID_ROWS);
  b.columns = cell_along(b.high.x, Model::grid_x(), Model::GRID_COLUMNS) + 1 - b.column;
  b.rows = cell_along(b.high.y, Model::grid_y(), Model::GRID_ROWS) + 1 - b.row;
  return b;
}

// Lists boxes whose bounds meet those of geoms, and looks at them together when the list is full, and at last.
INLINE void look_up_boxes(const bool round, const int first, const int end, const int kind, const bool friction) {
  const int listed = list_near(round, first, end);
  int count = 0, base = -LANES, before = 0, all = 0, next = 0, at = 0, last = 0, pair = first, row = 0, column = 0;
  ROLLED_FOR(bool is_last = listed == 0; !is_last;) {
    if (!ballot(at < last)) {  // the next cells of these geoms, or the next geoms
      if (next >= all) {
        base += LANES;
        is_last = base >= listed;
        all = next = 0;
        if (!is_last) {
          int cells = 0;
          if (base + lane < listed) {
            const Bounds b = bounds_of(round, w.near_pairs[base + lane]);
            cells = b.columns * b.rows;
          }
          before = sum_below(cells);
          all = read(before + cells, LANES - 1);
        }
      }
      if (next < all) {
        const Item item = dealt(before, all, next + lane);
        pair = item.exists ? w.near_pairs[base + item.owner] : first;
        const Bounds b = bounds_of(round, pair);
        row = b.row + item.number / b.columns;
        column = b.column + item.number % b.columns;
        const int cell = row * Model::GRID_COLUMNS + column;
        at = item.exists ? first_named(cell) : 0;
        last = item.exists ? first_named(cell + 1) : 0;
        next += LANES;
      }
    }
    bool near = at < last;
    const int i = near ? named(at++) : 0;
    if (near) {  // each in the first of its cells that the geom has
      const Bounds own = bounds_of(round, pair);
      const GroundBox box = ground_box(i);
      const Vec a = box.low(), b = box.high();
      near = a.x <= own.high.x && a.y <= own.high.y && a.z <= own.high.z && own.low.x <= b.x && own.low.y <= b.y &&
             own.low.z <= b.z;
      near = near && column == (box.column() > own.column ? box.column() : own.column);
      near = near && row == (box.row() > own.row ? box.row() : own.row);
      near = near && (Model::BOX_KINDS == 1 || box.kind() == kind);
    }
    const unsigned hits = ballot(near);
    if (near) w.near_ground[count + bits(hits & lanes_below())] = (unsigned)(pair - first) << 24 | (unsigned)i;
    count += bits(hits);
    if (count > (is_last ? 0 : Model::NEAR_GROUND - LANES)) {
      sync();
      touch_ground_boxes(round, first, count, friction);
      sync();
      count = 0;
    }
  }
}

INLINE void look_up_boxes(const bool round, const bool friction) {
  ROLLED_FOR(int kind = 0; kind < Model::BOX_KINDS; ++kind) {
    const int i = 8 * kind + 4 * round + 2 * friction;
    look_up_boxes(round, Model::on_boxes_pair(i), Model::on_boxes_pair(i + 1), kind, friction);
  }
}
INLINE void collide_round_on_boxes(const bool friction) { look_up_boxes(true, friction); }
INLINE void collide_box_on_boxes(const bool friction) { look_up_boxes(false, friction); }
#endif
