// Contacts with planes of the world.

// Spheres and the ends of capsules against planes of the world.
INLINE void collide_round_on_plane(const OwnPair own, const bool friction) {
  const int pair = own.pair;
  const Geom geom = w.geoms[Model::second_geom(pair)];
  const Vec normal = Model::plane_normal(pair);
  const float height = normal.dot(geom.center) + normal.dot(w.com[0]) - Model::plane_offset(pair) - geom.radius;
  const float rise = normal.dot(geom.half_axis), inverse_half = Model::inverse_half_length(pair);
  ROLLED_FOR(int side = 0; side < 2; ++side) {
    const float sign = side ? -1.0f : 1.0f, distance = height + sign * rise;
    const bool exists = own.valid && (side == 0 || inverse_half > 0.0f);
    add_contact(exists && distance < Model::margin(pair), friction, pair, side,
                geom.center + geom.half_axis * sign - normal * (geom.radius + 0.5f * distance), distance, normal,
                geom.half_axis * inverse_half);
  }
}

#if WITH_SOLID_ON_PLANE
struct Corner {
  int vertex, corner;
};  // of a mesh; the corner is that of a face, or -1

// The lowest vertex of a mesh over a plane with normal n, and its corner of the face that is most parallel to it.
static INLINE Corner lowest_corner(int g, Vec n) {
  Corner lowest = {Model::first_vertex(g), -1};
  const int end = Model::last_vertex(g);
  float least = 1e30f;
  ROLLED_FOR(int i = lowest.vertex; i < end; ++i) {
    const float height = n.dot(Model::vertex(i));
    if (!(height < least)) continue;
    least = height;
    lowest.vertex = i;
  }
  float facing = 1.0f;
  const int last = Model::first_corner(lowest.vertex + 1);
  ROLLED_FOR(int i = Model::first_corner(lowest.vertex); i < last; ++i) {
    const float x = n.dot(Model::corner_normal(i));
    if (!(x < facing)) continue;
    facing = x;
    lowest.corner = i;
  }
  return lowest;
}

// Point k of a mesh that may touch the plane: the vertex, and those of the face that are below the center.
static INLINE bool vertex_below(Corner lowest, int k, Vec n, Vec& point) {
  const int i = k == 0 ? lowest.vertex : lowest.corner < 0 ? -1 : Model::corner_vertex(3 * lowest.corner + k - 1);
  if (i < 0) return false;
  point = Model::vertex(i);
  return k == 0 || n.dot(point) <= 0.0f;
}

// Point k of a solid that may touch a plane with normal n, in the frame of the solid; returns false if there is none.
static INLINE bool point_below(int g, int k, Vec n, Vec& point) {
  const Vec size = Model::geom_size(g);
  const int shape = Model::geom_shape(g);
  if (shape == ELLIPSOID) {  // the support point
    const Vec p = {n.x * size.x, n.y * size.y, n.z * size.z};
    const float inverse = divide(-1.0f, larger(p.norm(), MINVAL));
    point = {p.x * size.x * inverse, p.y * size.y * inverse, p.z * size.z * inverse};
    return k == 0;
  }
  if (shape == CYLINDER) {
    // The lowest point of each rim, and two more of the lower rim, which make an equilateral triangle. All of the rim
    // of an upright cylinder is lowest: the first point is then on its x axis.
    const float radius = size.x, level = root(n.x * n.x + n.y * n.y), scale = divide(-radius, level);
    const bool upright = level < 1e-6f;
    const float x = upright ? radius : n.x * scale, y = upright ? 0.0f : n.y * scale;
    const float down = n.z > 0.0f ? -size.y : size.y, aside = k == 2 ? 0.866025404f : -0.866025404f;
    if (k < 2) point = {x, y, k == 0 ? down : -down};
    else point = {aside * y - 0.5f * x, -aside * x - 0.5f * y, down};
    return true;
  }
  // A box: of each two opposite corners the lower one.
  point = {k & 1 ? size.x : -size.x, k & 2 ? size.y : -size.y, -size.z};
  if (n.dot(point) > 0.0f) point = point * -1.0f;
  return true;
}

// Boxes, cylinders, ellipsoids and meshes against planes of the world.
INLINE void collide_solid_on_plane(const OwnPair own, const bool friction) {
  const int pair = own.pair, g = Model::second_geom(pair);
  const Geom geom = w.geoms[g];
  const Vec normal = Model::plane_normal(pair);
  const float height = normal.dot(geom.center) + normal.dot(w.com[0]) - Model::plane_offset(pair);
  const bool near = own.valid && height - geom.radius < Model::margin(pair);
  if (!ballot(near)) return;
  const Mat axes = geom_axes(g);
  const Vec n = axes.transposed_times(normal);
  const bool is_mesh = Model::MESHES && near && Model::geom_shape(g) == MESH;
  const Corner lowest = is_mesh ? lowest_corner(g, n) : Corner{0, -1};
  ROLLED_FOR(int k = 0; k < 4; ++k) {
    Vec point;
    const bool exists = is_mesh ? vertex_below(lowest, k, n, point) : point_below(g, k, n, point);
    const float distance = height + n.dot(point);
    add_contact(near && exists && distance < Model::margin(pair), friction, pair, k,
                geom.center + axes * point - normal * (0.5f * distance), distance, normal);
  }
}
#endif
