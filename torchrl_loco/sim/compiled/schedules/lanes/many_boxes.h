// Contacts with the boxes of the world, if they are many: a grid of cells names those that a geom may touch.
struct ManyBoxContacts : FieldContacts {
  using FieldContacts::FieldContacts;

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
    const int g = round ? Model::first_geom(pair) : Model::second_geom(pair);
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

  INLINE void look_up_boxes(const bool round, const int first, const int end, const int kind, const bool friction) {
    ROLLED_FOR(int base = first; base < end; base += LANES) {
      const bool valid = base + lane < end;
      const int pair = valid ? base + lane : first;
      const Vec center = w.geoms[round ? Model::first_geom(pair) : Model::second_geom(pair)].center + w.com[0];
      const Vec reach = reach_of(round, pair), low = center - reach, high = center + reach;
      const int column = cell_along(low.x, Model::grid_x(), Model::GRID_COLUMNS);
      const int row = cell_along(low.y, Model::grid_y(), Model::GRID_ROWS);
      const int columns = cell_along(high.x, Model::grid_x(), Model::GRID_COLUMNS) + 1 - column;
      const int rows = cell_along(high.y, Model::grid_y(), Model::GRID_ROWS) + 1 - row;
      const int cells = valid ? columns * rows : 0;
      int cell = -1, at = 0, last = 0;
      // Lists boxes whose bounds meet those of the geoms, each in the first of its cells that a geom has, then looks at them.
      while (ballot(cell < cells)) {
        int count = 0;
        while (ballot(cell < cells) && count <= Model::NEAR_GROUND - LANES) {
          while (at == last && cell < cells) {
            ++cell;
            const int k = (row + cell / columns) * Model::GRID_COLUMNS + column + cell % columns;
            at = cell < cells ? first_named(k) : 0;
            last = cell < cells ? first_named(k + 1) : 0;
          }
          bool near = cell < cells;
          const int i = near ? named(at++) : 0;
          if (near) {
            const GroundBox box = ground_box(i);
            const Vec a = box.low(), b = box.high();
            near = a.x <= high.x && a.y <= high.y && a.z <= high.z && low.x <= b.x && low.y <= b.y && low.z <= b.z;
            const int own_column = box.column() > column ? box.column() : column;
            const int own_row = box.row() > row ? box.row() : row;
            near = near && own_column == column + cell % columns && own_row == row + cell / columns;
            near = near && (Model::BOX_KINDS == 1 || box.kind() == kind);
          }
          const unsigned hits = ballot(near);
          if (near) w.near_ground[count + bits(hits & lanes_below())] = (unsigned)(pair - first) << 24 | (unsigned)i;
          count += bits(hits);
        }
        sync();
        touch_ground_boxes(round, first, count, friction);
        sync();
      }
    }
  }
#endif

#if WITH_ROUND_ON_BOXES
  INLINE void collide_round_on_boxes(const int, const int, const bool friction) {
    ROLLED_FOR(int kind = 0; kind < Model::BOX_KINDS; ++kind) {
      const int i = 4 * kind + 2 * friction;
      look_up_boxes(true, Model::round_on_boxes_pair(i), Model::round_on_boxes_pair(i + 1), kind, friction);
    }
  }
#endif
#if WITH_BOX_ON_BOXES
  INLINE void collide_box_on_boxes(const int, const int, const bool friction) {
    ROLLED_FOR(int kind = 0; kind < Model::BOX_KINDS; ++kind) {
      const int i = 4 * kind + 2 * friction;
      look_up_boxes(false, Model::box_on_boxes_pair(i), Model::box_on_boxes_pair(i + 1), kind, friction);
    }
  }
#endif
};
