// The contacts of a world, and its pairs of geoms that are near. Points are relative to the centre of mass of the first tree.

int frictional, frictionless;  // contacts

// Contacts with friction come first, then those without, each from a place of its own.
INLINE int place_of(int i) const { return i < frictional ? i : Model::FRICTIONAL + i - frictional; }
INLINE const Contact& contact(int i) const { return w.contacts[place_of(i)]; }

INLINE void place_geoms() {
  SHARED_LOOP(g, Model::GEOMS) {
    const Pose pose = pose_of(Model::geom_link(g));
    w.geoms[g] = {pose.position - w.com[0] + pose.orientation * Model::geom_position(g),
                  pose.orientation * Model::geom_half_axis(g), Model::geom_radius(g)};
  }
  sync();
}

// The deepest contacts stay: one that finds no place takes that of the shallowest. Returns the place of this lane's
// contact, or none of them. Rows that last (equalities, welds, limits of balls) come first, and keep theirs.
INLINE int make_room(bool touches, Contact* stored, int place, int places, int id, float depth) const {
  if (touches && place < places) {
    stored[place].distance = depth;
    stored[place].id = id;
  }
  sync();
  ROLLED_FOR(unsigned late = ballot(touches && place >= places); late; late &= late - 1) {
    const int from = lowest_bit(late);
    const float new_depth = read(depth, from);
    float shallowest = -1e30f;
    int at = places;
    SHARED_LOOP(i, places) {
      if (stored[i].distance <= shallowest || (Model::LASTING && stored[i].pair() >= Model::PAIRS)) continue;
      shallowest = stored[i].distance;
      at = i;
    }
    largest(shallowest, at);
    if (new_depth < shallowest) {
      if (lane == from) {
        place = at;
        stored[at].distance = depth;
        stored[at].id = id;
      } else if (place == at) {
        place = places;
      }
    }
    sync();
  }
  return place;
}

// Stores a contact where `touches`. The first tangent follows the hint, unless that is nearly normal (or nothing);
// then a coordinate axis. All lanes call this together, so that contacts lie in the order of the lanes.
INLINE void add_contact(bool touches, const bool friction, int pair, int number, Vec point, float distance, Vec normal,
                        Vec hint = {}) {
  const int id = pair << Model::POINT_BITS | number;
  const int left = Model::JACOBIAN_ROWS - DIRECTIONS * frictional;
  const int places = friction ? Model::FRICTIONAL : left < Model::FRICTIONLESS ? left : Model::FRICTIONLESS;
  // Not a reference to either: then all of Step would lie in memory, and shared memory be read as any other.
  int count = friction ? frictional : frictionless;
  const unsigned hits = ballot(touches);
  int place = count + bits(hits & lanes_below());
  count += bits(hits);
  if (count > places) {
    count = places;
    flag(NO_PLACE);
    place = make_room(touches, w.contacts + (friction ? 0 : Model::FRICTIONAL), place, places, id,
                      distance - Model::margin(pair));
  }
  if (friction) frictional = count;
  else frictionless = count;
  if (!touches || place >= places) return;
  w.contacts[friction ? place : Model::FRICTIONAL + place] = {point, distance - Model::margin(pair), normal, id};
  if (!friction) return;
  w.tangents[place] = Frame::tangent(normal, hint, Model::least_aligned());
}

#if WITH_SOLIDS
INLINE Mat geom_axes(int g) const {  // by rows
  const Mat link = pose_of(Model::geom_link(g)).orientation, own = Model::geom_orientation(g);
  if (!Model::SOLIDS_TURNED) return link;
  return {own.transposed_times(link.row0), own.transposed_times(link.row1), own.transposed_times(link.row2)};
}
#endif

// Lists the pairs of moving geoms whose bounding spheres are within their margin, in their order, and returns how many
// there are. A pair is one number: the square of what is within, with the geoms in its lowest bits.
INLINE int near_pairs() {
  enum { ROUNDS = LANES > 1 ? Model::NEAR_ROUNDS : 1 };  // side by side, as few find a pair
  const unsigned geom = (1u << Model::GEOM_BITS) - 1;
  int count = 0;
  ROLLED_FOR(int base = Model::PLANE_PAIRS; base < Model::PAIRS; base += ROUNDS * LANES) {
    unsigned near = 0;
    UNROLLED_FOR(int k = 0; k < ROUNDS; ++k) {
      const unsigned pair = Model::near_pair(base - Model::PLANE_PAIRS + LANES * k + lane);
      const Vec between = w.geoms[pair & geom].center - w.geoms[pair >> Model::GEOM_BITS & geom].center;
      if (between.dot(between) < from_bits(pair)) near |= 1u << k;
    }
    if (!ballot(near)) continue;
    ROLLED_FOR(int k = 0; k < ROUNDS; ++k) {
      const bool own = near >> k & 1;
      const unsigned hits = ballot(own);
      if (own) w.candidates[count + bits(hits & lanes_below())] = (unsigned short)(base + LANES * k + lane);
      count += bits(hits);
    }
  }
  sync();
  return count;
}

// This lane's pair, if there is one for it: of those from `begin` on, up to `end`; or of those that are listed from `at`
// on, up to pair `end`, where `at` moves on by all that the lanes have.
struct OwnPair {
  int pair;
  bool valid;
};
INLINE OwnPair own_pair(const int begin, const int end) const {
  const bool valid = begin + lane < end;
  return {valid ? begin + lane : begin, valid};
}
INLINE OwnPair own_pair(int& at, const int count, const int end) const {
  const int pair = at + lane < count ? w.candidates[at + lane] : end;
  const bool valid = pair < end;
  at += bits(ballot(valid));
  return {valid ? pair : Model::PLANE_PAIRS, valid};
}
