// Contacts of boxes with each other. They lie along the axis on which the boxes overlap least: the normal of a face, whose
// outline cuts the face of the other box that looks against it; or the normal of two edges, at their nearest points. The
// choices are those of MuJoCo's mjc_BoxBox. All is in the frame of the first box.

#if WITH_BOX_AND_BOX || WITH_BOX_ON_BOXES
enum { CORNERS = 8 };  // of a face that four planes have cut
struct Touching {
  int count;
  Vec normal, points[CORNERS];
  float distances[CORNERS];
};

static INLINE Vec magnitude(Vec v) { return {fabsf(v.x), fabsf(v.y), fabsf(v.z)}; }
static INLINE Vec signs(Vec v) {
  return {v.x < 0.0f ? -1.0f : 1.0f, v.y < 0.0f ? -1.0f : 1.0f, v.z < 0.0f ? -1.0f : 1.0f};
}
static INLINE Vec by_component(Vec a, Vec b) { return {a.x * b.x, a.y * b.y, a.z * b.z}; }
static INLINE Mat of_columns(Vec a, Vec b, Vec c) { return {{a.x, b.x, c.x}, {a.y, b.y, c.y}, {a.z, b.z, c.z}}; }
static INLINE int next(int axis) { return axis < 2 ? axis + 1 : 0; }

// An axis besides `along` in which a direction has nothing, so that both edges there are as far out, or -1.
static INLINE int level_axis(Vec n, int along) {
  const int k = next(along), l = next(k);
  return fabsf(n.component(k)) < 1e-5f ? k : fabsf(n.component(l)) < 1e-5f ? l : -1;
}

// The middle of the edge along an axis that is farthest in the direction n times `facing`; mirrored in an axis, or -1.
static INLINE Vec edge_of(Vec size, Vec n, float facing, int along, int mirrored) {
  Vec middle = by_component(signs(n) * facing, size);
  if (mirrored >= 0) middle = middle - Vec::unit(mirrored) * (2.0f * middle.component(mirrored));
  return middle - Vec::unit(along) * middle.component(along);
}

// The nearest points of two edges, along axis i of the first box and j of the second, on the side to which `normal`
// points; of several edges that are as far out there, the nearest.
static INLINE void touch_edges(Vec offset, const Mat& turn, Vec first, Vec second, int i, int j, Vec normal,
                               Touching& found) {
  const Vec of_second = turn.transposed_times(normal), along = turn.column(j);
  const float cosine = along.component(i), across = 1.0f - cosine * cosine;
  const int level = level_axis(normal, i), other_level = level_axis(of_second, j);
  float nearest = 1e30f;
  ROLLED_FOR(int choice = 0; choice < 4; ++choice) {
    const bool mirrored = choice & 1, other_mirrored = choice & 2;
    if ((mirrored && level < 0) || (other_mirrored && other_level < 0)) continue;
    const Vec corner = edge_of(first, normal, 1.0f, i, mirrored ? level : -1);
    const Vec other = edge_of(second, of_second, -1.0f, j, other_mirrored ? other_level : -1);
    const Vec start = turn * other + offset, between = start - corner;
    const float ahead = between.component(i), behind = along.dot(between);
    const float reach = first.component(i), other_reach = second.component(j);
    float s = across >= MINVAL ? clamp(divide(ahead - cosine * behind, across), -reach, reach) : 0.0f;
    const float t = clamp(cosine * s - behind, -other_reach, other_reach);
    s = clamp(ahead + cosine * t, -reach, reach);
    const Vec from = corner + Vec::unit(i) * s, to = start + along * t, gap = to - from;
    if (!(gap.dot(gap) < nearest)) continue;
    nearest = gap.dot(gap);
    found.distances[0] = gap.dot(normal);
    found.points[0] = (from + to) * 0.5f;
  }
  found.count = 1;
  found.normal = normal;
}

// Cuts off what of a polygon is beyond `limit` along x or y, in the direction of a sign. Returns how many corners it has.
static INLINE int cut(Vec* corners, const int count, const bool along_y, const float sign, const float limit) {
  Vec left[CORNERS];
  int kept = 0;
  Vec from = corners[count - 1];
  float beyond = sign * (along_y ? from.y : from.x) - limit;
  ROLLED_FOR(int k = 0; k < count; ++k) {
    const Vec to = corners[k];
    const float next_beyond = sign * (along_y ? to.y : to.x) - limit;
    if (((beyond < 0.0f) & (next_beyond > 0.0f)) | ((beyond > 0.0f) & (next_beyond < 0.0f)) && kept < CORNERS)
      left[kept++] = from + (to - from) * divide(beyond, beyond - next_beyond);
    if (next_beyond <= 0.0f && kept < CORNERS) left[kept++] = to;
    from = to;
    beyond = next_beyond;
  }
  ROLLED_FOR(int k = 0; k < kept; ++k) corners[k] = left[k];
  return kept;
}

// A face of a box, along `axis`, that another one rests on: corners of the face of that one, as far as they are over it and
// within the margin. All is in the frame of the box: the other's center, and its axes as columns.
static INLINE void touch_face(Vec center, const Mat& turn, Vec size, Vec other, int axis, float margin,
                              Touching& found) {
  const float side = center.component(axis) < 0.0f ? -1.0f : 1.0f;
  const Vec towards = turn.transposed_times(Vec::unit(axis)), steep = magnitude(towards);
  const int against = steep.y > steep.x ? (steep.z > steep.y ? 2 : 1) : steep.z > steep.x ? 2 : 0;
  const int u = next(against), v = next(u), x = next(axis), y = next(x);
  const Vec out = turn.column(against) *
                  (side * towards.component(against) > 0.0f ? -other.component(against) : other.component(against));
  const Vec wide = turn.column(u) * other.component(u), high = turn.column(v) * other.component(v);
  Vec corners[CORNERS];
  ROLLED_FOR(int k = 0; k < 4; ++k) {
    const Vec p = center + out + wide * (k == 1 || k == 2 ? -1.0f : 1.0f) + high * (k < 2 ? 1.0f : -1.0f);
    corners[k] = {p.component(x), p.component(y), side * p.component(axis) - size.component(axis)};
  }
  const float width = size.component(x), height = size.component(y);
  int count = 4;
  ROLLED_FOR(int edge = 0; edge < 4 && count > 0; ++edge)
    count = cut(corners, count, edge > 1, edge & 1 ? -1.0f : 1.0f, edge > 1 ? height : width);
  const float same = 1e-10f * (width * width + height * height);
  found.normal = Vec::unit(axis) * side;
  ROLLED_FOR(int k = 0; k < count; ++k) {
    const Vec c = corners[k];
    bool is_new = c.z <= margin;
    ROLLED_FOR(int l = 0; l < found.count; ++l) {
      const float dx = found.points[l].component(x) - c.x, dy = found.points[l].component(y) - c.y;
      is_new = is_new && !(dx * dx + dy * dy < same);
    }
    if (!is_new) continue;
    found.distances[found.count] = c.z;
    found.points[found.count++] =
        Vec::unit(x) * c.x + Vec::unit(y) * c.y + Vec::unit(axis) * (side * (size.component(axis) + 0.5f * c.z));
  }
}

// Takes the second's center and axes (columns) in the frame of the first, and nothing found so far.
static INLINE void touch_boxes(Vec center, const Mat& turn, Vec first, Vec second, float margin, Touching& found) {
  const Vec back = turn.transposed_times(center) * -1.0f;
  const Vec ones = {1.0f, 1.0f, 1.0f};
  const float apart = margin + 1e-6f * ones.dot(first + second);  // rounding does not part them
  float gap = -1e30f, face_gap = -1e30f;
  int face = 0, edges = -1;
  Vec normal = {0.0f, 0.0f, 0.0f};
  ROLLED_FOR(int i = 0; i < 15; ++i) {
    const int k = i % 3, l = (i - 6) / 3;
    const bool is_edge = i >= 6;
    Vec n = i < 3 ? Vec::unit(k) : turn.column(k);
    if (is_edge) {
      n = Vec::unit(l).cross(n);
      const float squared = n.dot(n);
      if (squared < 1e-7f) continue;  // parallel
      n = n * divide(1.0f, root(squared));
    }
    const float left = fabsf(n.dot(center)) - magnitude(n).dot(first) - magnitude(turn.transposed_times(n)).dot(second);
    if (left > apart) return;
    if (!is_edge && left > face_gap) {
      face_gap = gap = left;
      face = i;
    } else if (is_edge && left - 1e-6f * fabsf(left) > gap && left > face_gap) {
      gap = left;
      edges = i - 6;
      normal = n;
    }
  }
  if (edges >= 0) {  // a face that is nearly as good has more contacts
    const Vec of_face = face < 3 ? Vec::unit(face) : turn.column(face - 3);
    if (fabsf(normal.dot(of_face)) > 0.99f && gap < face_gap + 0.05f * fabsf(face_gap) + MINVAL) edges = -1;
  }
  if (edges >= 0) {
    touch_edges(center, turn, first, second, edges / 3, edges % 3, normal.dot(center) < 0.0f ? normal * -1.0f : normal,
                found);
  } else if (face < 3) {
    touch_face(center, turn, first, second, face, margin, found);
  } else {  // the frame of the second
    touch_face(back, of_columns(turn.row0, turn.row1, turn.row2), second, first, face - 3, margin, found);
    found.normal = turn * found.normal * -1.0f;
    ROLLED_FOR(int k = 0; k < found.count; ++k) found.points[k] = turn * found.points[k] + center;
  }
}

// Adds the contacts of a box with the second geom of a pair, where `near`.
INLINE void touch_box_and_box(bool near, int pair, Vec origin, const Mat& axes, Vec size, const bool friction) {
  const int h = Model::second_geom(pair);
  const Mat others = geom_axes(h);
  Vec columns[3];
  UNROLLED_FOR(int i = 0; i < 3; ++i) columns[i] = axes.transposed_times(others.column(i));
  const Mat turn = of_columns(columns[0], columns[1], columns[2]);
  Touching found = {};
  if (near)
    touch_boxes(axes.transposed_times(w.geoms[h].center - origin), turn, size, Model::geom_size(h), Model::margin(pair),
                found);
  const Vec normal = axes * found.normal;
  ROLLED_FOR(int k = 0; k < CORNERS; ++k) {
    const bool exists = k < found.count;
    if (!ballot(exists)) break;
    const float distance = exists ? found.distances[k] : 0.0f;
    add_contact(exists && distance < Model::margin(pair), friction, pair, k,
                origin + axes * found.points[exists ? k : 0], distance, normal);
  }
}

#if WITH_BOX_AND_BOX
INLINE void collide_box_and_box(const OwnPair own, const bool friction) {
  const int g = Model::first_geom(own.pair);
  touch_box_and_box(own.valid, own.pair, w.geoms[g].center, geom_axes(g), Model::geom_size(g), friction);
}
#endif
#endif
