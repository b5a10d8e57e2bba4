// One control step of one world, taken by a group of lanes: a warp of a GPU with the world's state in shared memory, or
// one lane of a CPU. All of it is the body of a single function, so that Warp can carry it; what depends on the model
// (struct Model: sizes, constants and tables) is written into it by lanes.py.
//
// The lanes share every loop over links, geoms, contacts or rows. Each of them owns the degrees of freedom lane,
// lane + LANES, ... (its slots), and with them their rows of the mass matrix and of the Hessian, which it keeps in
// registers. Loops stay rolled where they can: on a GPU, fetching instructions is what limits a text of this size.
//
// Sums are written with the accumulator first, so that a compiler fuses each product with its addition.

//SHARED
#ifdef __CUDA_ARCH__
enum { LANES = 32 };
#else
enum { LANES = 1 };
#endif

// Spatial vectors, as in spatial.py.
struct alignas(16) Motion {
  Vec angular, linear;
  INLINE Motion operator+(Motion b) const { return {angular + b.angular, linear + b.linear}; }
  INLINE Motion operator*(float k) const { return {angular * k, linear * k}; }
  INLINE float dot(Motion b) const { return angular.dot(b.angular) + linear.dot(b.linear); }
};

struct Inertia {
  Symmetric rotational;  // about the origin
  Vec first;             // mass times the offset of the centre of mass
  float mass;
};

//SPATIAL

// Of a constraint: solref and solimp.
//SOFTNESS

// ---- The model -----------------------------------------------------------------------------------------------------

enum Joint { FREE, BALL, SLIDE_JOINT, HINGE_JOINT };
enum Dof { TRANSLATION, ROTATION, SLIDE, HINGE };  // of a free joint; of a free or ball joint; the two others

//MODEL

// The numbers of the model of a world, and what follows from them.
struct Row {
  const float* const data;
  INLINE float operator[](int i) const {
#ifdef __CUDA_ARCH__
    if (Model::SUBSTEPS > 0) return __ldg(data + i);  // a step only reads them
#endif
    return data[i];
  }
};

//VARYING

// ---- The state of a world ------------------------------------------------------------------------------------------

enum {
  DOFS = Model::DOFS,
  STRIDE = (DOFS + 3) / 4 * 4,  // of a row of a matrix; the columns beyond DOFS are zero
  QUADS = STRIDE / 4,
  PITCH = 4 * (QUADS | 1),  // of rows that several lanes write at once: they begin in different banks
  SLOTS = (STRIDE + LANES - 1) / LANES,
  LINK_SLOTS = (Model::LINKS + LANES - 1) / LANES,
  SEVERAL_ROWS = SLOTS > 1,  // a lane has some: then what spares rounds pays for a longer text
  CONTACTS = Model::FRICTIONAL + Model::FRICTIONLESS,
  // A lane looks after the contacts lane, lane + LANES, ... with friction, then after those without.
  OWN_FRICTIONAL = (Model::FRICTIONAL + LANES - 1) / LANES,
  GUESSES = Model::SUBSTEPS > 1 && Model::ITERATIONS > 2,  // a guess that is refused has cost one of them
  CONTACT_SLOTS = OWN_FRICTIONAL + (Model::FRICTIONLESS + LANES - 1) / LANES,
  POINT_BITS = 2,
  SIDE_BITS = 10,  // of a contact: which edges of its pyramid are closed, the state of its cone, or whether it is closed
  NO_CONTACT = (1u << (32 - SIDE_BITS)) - 1,  // an id that none has
  // Columns are left out where a lane knows those of a contact of each kind; alone, it looks at each number itself.
  SKIPS_QUADS = SEVERAL_ROWS && LANES > 1 && Model::FRICTIONAL <= LANES && Model::FRICTIONLESS <= LANES,
  DIRECTIONS = Model::DIRECTIONS,  // in which a contact with friction acts, each with a row of the Jacobian
  CONTACT_ROWS = Model::CONTACT_ROWS,  // the constraint rows of such a contact
//IF LIMBS
  TRUNK = Model::TRUNK,  // degrees of freedom that several limbs share, and those of the longest limb
  LIMB = Model::LIMB,
  PIVOT = (TRUNK + LIMB + 4) / 4 * 4,  // a row of a limb: columns of the trunk, the gradient, columns of the limb
  LOWER = (TRUNK + 3) / 4 * 4,
  CORNER = (LOWER + TRUNK * (TRUNK + 1) / 2 + 3) / 4 * 4,  // of the trunk: the gradient, then the lower triangle
//END
};
#define OWN_DOFS(slot, dof) UNROLLED for (int slot = 0, dof = lane; slot < SLOTS; ++slot, dof += LANES)
#define OWN_LINKS(slot, link) UNROLLED for (int slot = 0, link = lane; slot < LINK_SLOTS; ++slot, link += LANES)
// Own contacts; rolled on a CPU, where they are all of them.
#ifdef __CUDA_ARCH__
#define OWN_PLACES(own, begin, end) UNROLLED for (int own = begin; own < (end); ++own)
#else
#define OWN_PLACES(own, begin, end) ROLLED for (int own = begin; own < (end); ++own)
#endif
// Contacts that are taken to be closed: `left` has a bit for each of the lanes whose own ones have not been visited.
#define CLOSED_CONTACTS(own, left, begin, end) \
  OWN_PLACES(own, begin, end) ROLLED for (unsigned left = ballot(sides(own)); left; left &= left - 1)
#define SHARED_LOOP(i, count) ROLLED for (int i = lane; i < (count); i += LANES)

struct alignas(16) Quad { float v[4]; };

struct LocalPose {
  Quat orientation;
  Vec position;
  INLINE LocalPose after(const LocalPose& parent) const {
    return {parent.orientation * orientation, parent.position + parent.orientation.rotate(position)};
  }
};
struct alignas(16) Pose { Mat orientation; Vec position; };
struct alignas(16) Body { Inertia inertia; Vec torque, force; };  // 16 floats
struct alignas(16) Geom { Vec center, half_axis; float radius; };  // only a capsule has a half axis
struct alignas(16) Contact {
  Vec point;
  float distance;
  Vec normal;
  int id;  // the pair, and in the lowest bits which of its contacts it is
  INLINE int pair() const { return id >> POINT_BITS; }
};

struct alignas(16) World {
  float qpos[(Model::POSITIONS + 3) / 4 * 4];
  float qvel[STRIDE], qacc[STRIDE], search[STRIDE];
  float residual[STRIDE];     // M qacc minus the smooth forces
  float mass[DOFS * STRIDE];
  union {
    Motion axes[DOFS];  // until the Jacobian is set up: of the tree for a unit velocity of each degree of freedom (cdof)
    struct {
      float mass_search[STRIDE];  // M times the search direction
      // Constraint rows: residual J qacc - aref, weight D. They cost D x^2 / 2 where x < 0, all but those of cones.
      float x[Model::ROWS], weight[Model::ROWS];
    };
  };
  union {
    struct {  // until the rows are set up
      Contact contacts[CONTACTS];
      Vec tangents[Model::FRICTIONAL + 1];
    };
    struct {  // while a direction is sought
      float pivots[4][PITCH], pivot_damping[4], pivot_gradient[4];
      float blocks[QUADS][12];
    };
//IF LIMBS
    struct { float limb_pivots[2][Model::LIMBS * PIVOT], corner[CORNER]; };
//END
    float change[Model::ROWS];  // of the residuals, along the direction
    Motion velocity[Model::LINKS];  // of each link
  };
  float projected[Model::JACOBIAN_ROWS];  // Jacobian times the search direction
  union {
    struct {  // until the contacts are known
      Motion momentum[DOFS];  // of the subtree that a degree of freedom moves, at unit velocity
      Pose pose[Model::LINKS];
      Body bodies[Model::LINKS];
      Geom geoms[Model::GEOMS + 1];
      unsigned short candidates[Model::CANDIDATES];
    };
    float jacobian[Model::JACOBIAN_ROWS * STRIDE];
  };
  Vec com[Model::TREES];
  unsigned char limits[Model::LIMITS + 1];  // the degree of freedom of each row of a limit, plus 128 for the upper one
  unsigned zones[Model::TOUCH ? CONTACTS : 1];  // the touch sensors that feel each contact, one bit each
};

// ---- Friction ------------------------------------------------------------------------------------------------------

// The law of a contact with friction: gradient and Hessian of its cost, as a function of its residuals in its
// directions, which are the normal, two tangents, and turning about these three.

//IF ELLIPTIC
// An elliptic cone. With a residual n along the normal and one of length t off it, it costs D / 2 times their squared
// distance from n >= mu t. That is a parabola of how far they lie beside the cone, and one of how far beyond its tip,
// each with one side (in the plane of n and t, the two axes are at right angles):
//   D / (1 + mu^2) / 2 (min(beside, 0)^2 + min(beyond, 0)^2),  beside = n - mu t,  beyond = mu n + t.
// Neither counts while the contact is open, the first while it slides, both while it sticks.
struct Cone {
  enum State { OPEN, SLIDING, STICKING };
  float gradient[DIRECTIONS];
  // The Hessian: of the normal, of the normal with the way that the residual has off it, along that way, and across.
  float square, mixed, along, across;
  float way[DIRECTIONS];

  static INLINE float length(const float* x) {  // off the normal
    float squared = 0.0f;
    UNROLLED for (int j = 1; j < DIRECTIONS; ++j) squared += x[j] * x[j];
    return Math::root(squared);
  }
  static INLINE State state(float n, float t, float mu) {
    return !(n - mu * t < 0.0f) ? OPEN : mu * n + t > 0.0f ? SLIDING : STICKING;
  }
  static INLINE State state(const float* x, float mu) { return state(x[0], length(x), mu); }

  INLINE Cone(const float* x, float weight, float mu, unsigned in) {
    const float n = x[0], t = length(x), inverse = t > 0.0f ? Math::inverse(t) : 0.0f, beside = n - mu * t;
    const bool slides = in == SLIDING;
    square = in == OPEN ? 0.0f : slides ? Math::divide(weight, 1.0f + mu * mu) : weight;
    mixed = slides ? -mu * square : 0.0f;
    along = slides ? mu * mu * square : square;
    across = slides ? Math::larger(mixed * beside * inverse, 0.0f) : square;  // a guess may be beside
    gradient[0] = square * (slides ? beside : n);
    const float off = slides ? mixed * beside : square * t;
    UNROLLED for (int j = 1; j < DIRECTIONS; ++j) {
      way[j] = x[j] * inverse;
      gradient[j] = off * way[j];
    }
  }
  INLINE void times(const float* v, float* product) const {  // the Hessian
    float forward = 0.0f;
    UNROLLED for (int j = 1; j < DIRECTIONS; ++j) forward += way[j] * v[j];
    product[0] = square * v[0] + mixed * forward;
    const float common = mixed * v[0] + (along - across) * forward;
    UNROLLED for (int j = 1; j < DIRECTIONS; ++j) product[j] = common * way[j] + across * v[j];
  }

  // A contact along a search direction v: its residual is x + alpha v.
  struct Line {
    float n, n_speed;                 // along the normal, and how it changes
    float t, forward, speed_squared;  // off it: the length of x, its product with v, the square of v
    float nearest_squared, per_speed;  // the shortest length on the way; one over the square of v, or 0
    float weight, parabola, mu;

    INLINE void set(const float* x, const float* v, float own_weight, float own_mu) {
      float squared = forward = speed_squared = 0.0f;
      UNROLLED for (int j = 1; j < DIRECTIONS; ++j) {
        squared += x[j] * x[j];
        forward += x[j] * v[j];
        speed_squared += v[j] * v[j];
      }
      n = x[0];
      n_speed = v[0];
      t = Math::root(squared);
      per_speed = speed_squared > 1e-30f ? Math::inverse(speed_squared) : 0.0f;  // of less, it could be infinite
      nearest_squared = Math::larger(squared - forward * forward * per_speed, 0.0f);
      weight = own_weight;
      mu = own_mu;
      parabola = Math::divide(weight, 1.0f + mu * mu);
    }
    INLINE float cost() const {
      const float beside = Math::smaller(n - mu * t, 0.0f), beyond = Math::smaller(mu * n + t, 0.0f);
      return 0.5f * parabola * (beside * beside + beyond * beyond);
    }
    // The change of y^2, where it counts below zero, as y goes `by` from one value to another.
    static INLINE float grown(float from, float to, float by) {
      if (to < 0.0f) return from < 0.0f ? by * (from + to) : to * to;
      return from < 0.0f ? -from * from : 0.0f;
    }
    // Adds to three sums how the cost changes from x to x + alpha v, and its slope and curvature there.
    INLINE void add(float alpha, float* sums) const {
      const float next_forward = forward + alpha * speed_squared;
      const float squared = nearest_squared + next_forward * next_forward * per_speed;
      const float inverse = squared > 0.0f ? Math::inverse_root(squared) : 0.0f, next_t = squared * inverse;
      const float by_t = t + next_t > 0.0f ? Math::divide(alpha * (forward + next_forward), t + next_t) : 0.0f;
      const float by_n = alpha * n_speed, next_n = n + by_n, beside = next_n - mu * next_t;
      sums[0] += 0.5f * parabola * (grown(n - mu * t, beside, by_n - mu * by_t) +
                                    grown(mu * n + t, mu * next_n + next_t, mu * by_n + by_t));
      const State in = state(next_n, next_t, mu);
      if (in == STICKING) {
        sums[1] += weight * (next_n * n_speed + next_forward);
        sums[2] += weight * (n_speed * n_speed + speed_squared);
      } else if (in == SLIDING) {
        const float towards = next_forward * inverse, rate = n_speed - mu * towards;
        const float sideways = Math::larger(speed_squared - towards * towards, 0.0f);
        sums[1] += parabola * beside * rate;
        sums[2] += parabola * (rate * rate - mu * beside * sideways * inverse);
      }
    }
  };
};
typedef Cone Law;
//ELSE
// A pyramid. Its edges, the normal plus or minus one of the others, are rows of their own.
struct Pyramid {
  float gradient[DIRECTIONS];
  float square[DIRECTIONS], mixed[DIRECTIONS];  // of the Hessian: of each direction, and of the normal with it

  static INLINE unsigned sides(const float* x) {  // the closed ones
    unsigned found = 0;
    UNROLLED for (int i = 0; i < CONTACT_ROWS; ++i) found |= (unsigned)(x[i] < 0.0f) << i;
    return found;
  }
  INLINE Pyramid(const float* x, float weight, unsigned sides) {
    UNROLLED for (int j = 1; j < DIRECTIONS; ++j) {
      const float plus = x[2 * j - 2], minus = x[2 * j - 1];
      const float d = sides >> (2 * j - 2) & 1 ? weight : 0.0f, e = sides >> (2 * j - 1) & 1 ? weight : 0.0f;
      square[j] = d + e;
      mixed[j] = d - e;
      gradient[j] = d * plus - e * minus;
      square[0] = j == 1 ? square[1] : square[0] + square[j];
      gradient[0] = (j == 1 ? d * plus : gradient[0] + d * plus) + e * minus;
    }
  }
  INLINE void times(const float* v, float* product) const {  // the Hessian
    product[0] = square[0] * v[0];
    UNROLLED for (int j = 1; j < DIRECTIONS; ++j) {
      product[0] = product[0] + mixed[j] * v[j];
      product[j] = mixed[j] * v[0] + square[j] * v[j];
    }
  }
};
typedef Pyramid Law;
//END

// ---- One substep ---------------------------------------------------------------------------------------------------

struct Step : Math {
  World& w;
  const int lane;
  const float* const ctrl;  // of the world
  int& overflow;            // of the world
  int frictional, frictionless;  // contacts
  int limits;                    // violated limits of hinges and slides
  int limit_row[Model::LIMIT_SIDES][SLOTS];  // the row of the limit of each own degree of freedom, or -1
  // On which sides the next direction takes own contacts to be, below their ids, and own limits.
  unsigned contact_sides[CONTACT_SLOTS];
  enum LimitSide : unsigned char { NO_LIMIT, OPEN, CLOSED } limit_sides[Model::LIMIT_SIDES][SLOTS];
  int frictional_before, frictionless_before;  // contacts of the substep before
  // Of this lane's contacts, with friction and without, the quads of columns in which the Jacobian has numbers.
  unsigned frictional_quads, frictionless_quads;
//IF LIMBS
  bool crossing;  // whether a contact couples two limbs
//END
  float implicit_damping[SLOTS];  // minus the derivative of the force of each own degree of freedom by its velocity
  const Varied varied;
//IF CONTACT_GEOMS
  // What the solver overwrites of the contacts that this lane adds up: number lane, lane + LANES, ...
  enum { OWN_CONTACTS = (CONTACTS + LANES - 1) / LANES };
  struct OwnContact { Vec normal, tangent; int pair; } own_contacts[OWN_CONTACTS];
//END

  INLINE Step(World& w, int lane, const float* ctrl, int& overflow, const float* row)
      : w(w), lane(lane), ctrl(ctrl), overflow(overflow), varied{{row}} {
    frictional_before = frictionless_before = 0;
    OWN_DOFS(slot, d) UNROLLED for (int side = 0; side < Model::LIMIT_SIDES; ++side) limit_sides[side][slot] = NO_LIMIT;
  }

  // Jacobian rows and constraint rows, in their order. A contact with friction has a Jacobian row for each direction
  // (all but the normal times a factor), and a constraint row for each edge of its pyramid, or each direction of its
  // cone. Limits of hinges and slides, and dry friction in joints, need no Jacobian: they act along one degree of
  // freedom.
  INLINE int jacobian_rows() const { return DIRECTIONS * frictional + frictionless; }
  INLINE int first_frictionless() const { return CONTACT_ROWS * frictional; }
  INLINE int first_limit() const { return CONTACT_ROWS * frictional + frictionless; }
  INLINE int first_friction() const { return first_limit() + limits; }
  INLINE int rows() const { return first_friction() + Model::FRICTION_LOSSES; }
  // Rows from here on have a cost each; those of a cone have one together.
  INLINE int first_single() const { return Model::ELLIPTIC ? first_frictionless() : 0; }

  // ---- What the lanes do together

#ifdef __CUDA_ARCH__
  INLINE void sync() const { __syncwarp(); }
  INLINE unsigned ballot(bool x) const { return __ballot_sync(~0u, x); }
  INLINE bool any_of_block(bool x) const { return Model::LOCKSTEP && Model::SUBSTEPS ? __syncthreads_or(x) : x; }
  INLINE float read(float x, int from) const { return __shfl_sync(~0u, x, from); }
  INLINE int read(int x, int from) const { return __shfl_sync(~0u, x, from); }
  INLINE unsigned read(unsigned x, int from) const { return __shfl_sync(~0u, x, from); }
  // The number of a lane, which the compiler knows to be the same in all, except before Ampere.
#if __CUDA_ARCH__ >= 800
  INLINE unsigned agreed(unsigned x, int from) const { return __reduce_or_sync(~0u, lane == from ? x : 0u); }
#else
  INLINE unsigned agreed(unsigned x, int from) const { return __shfl_sync(~0u, x, from); }
#endif

  // Replaces each of n values by its sum over the lanes. With many of them, pairs of lanes first exchange halves, so
  // that each lane goes on with a quarter of the values.
  INLINE void sum(float* x, const int n) const {
    if (n < 6) {
      UNROLLED for (int i = 0; i < n; ++i)
        UNROLLED for (int o = 16; o; o >>= 1) x[i] += __shfl_xor_sync(~0u, x[i], o);
      return;
    }
    const bool odd = lane & 1, upper = lane & 2;
    float half[6], quarter[3];
    UNROLLED for (int i = 0; i < (n + 1) / 2; ++i) {
      const float a = x[2 * i], b = 2 * i + 1 < n ? x[2 * i + 1] : 0.0f;
      half[i] = (odd ? b : a) + __shfl_xor_sync(~0u, odd ? a : b, 1);
    }
    UNROLLED for (int i = 0; i < (n + 3) / 4; ++i) {
      const float a = half[2 * i], b = 2 * i + 1 < (n + 1) / 2 ? half[2 * i + 1] : 0.0f;
      quarter[i] = (upper ? b : a) + __shfl_xor_sync(~0u, upper ? a : b, 2);
      UNROLLED for (int o = 4; o < 32; o <<= 1) quarter[i] += __shfl_xor_sync(~0u, quarter[i], o);
    }
    UNROLLED for (int i = 0; i < n; ++i) x[i] = read(quarter[i / 4], i & 3);
  }

  // Replaces a value of each lane, and where it is, by those of the lane with the largest, or the first place of several.
  INLINE void largest(float& x, int& at) const {
    ROLLED for (int o = 16; o; o >>= 1) {
      const float other = __shfl_xor_sync(~0u, x, o);
      const int other_at = __shfl_xor_sync(~0u, at, o);
      if (other > x || (other == x && other_at < at)) {
        x = other;
        at = other_at;
      }
    }
  }
#else
  INLINE void sync() const {}
  INLINE unsigned ballot(bool x) const { return x; }
  INLINE bool any_of_block(bool x) const { return x; }
  INLINE float read(float x, int) const { return x; }
  INLINE int read(int x, int) const { return x; }
  INLINE unsigned read(unsigned x, int) const { return x; }
  INLINE unsigned agreed(unsigned x, int) const { return x; }
  INLINE void sum(float*, const int) const {}
  INLINE void largest(float&, int&) const {}
#endif
  INLINE unsigned lanes_below() const { return (1u << lane) - 1; }
  INLINE void flag(int bits) const {
    if (lane == 0 && Model::SUBSTEPS) overflow |= bits;
  }

  // ---- Kinematics

  // What each link has, from its owner.
  INLINE float of_link(const float* own, const int stride, int link) const {
    float value = read(own[0], (unsigned)link % LANES);
    UNROLLED for (int i = 1; i < LINK_SLOTS; ++i) {
      const float other = read(own[stride * i], (unsigned)link % LANES);
      if (link / LANES == i) value = other;
    }
    return value;
  }

  INLINE Vec of_link(const Vec* own, const int stride, int link) const {
    return {of_link(&own->x, stride, link), of_link(&own->y, stride, link), of_link(&own->z, stride, link)};
  }
  INLINE Motion of_link(const Motion* own, int link) const {
    enum { SIZE = sizeof(Motion) / sizeof(float) };
    return {of_link(&own->angular, SIZE, link), of_link(&own->linear, SIZE, link)};
  }
  INLINE LocalPose of_link(const LocalPose* own, int link) const {
    enum { SIZE = sizeof(LocalPose) / sizeof(float) };
    const Quat& q = own->orientation;
    return {{of_link(&q.w, SIZE, link), of_link(&q.x, SIZE, link), of_link(&q.y, SIZE, link), of_link(&q.z, SIZE, link)},
            of_link(&own->position, SIZE, link)};
  }

  // Adds to what each link has that of its ancestors, or puts its pose after theirs. In each round, a lane asks the
  // ancestor that is as far away as the round before reached. A single lane visits the links in their order, parents
  // first.
  INLINE void sum_to_root(Motion* own) const {
    if (LANES == 1) {
      for (int b = 0; b < Model::LINKS; ++b)
        if (Model::parent(b) >= 0) own[b] = own[b] + own[Model::parent(b)];
      return;
    }
    ROLLED for (int round = 0; round < Model::ROUNDS; ++round) {
      Motion others[LINK_SLOTS];
      int above[LINK_SLOTS];
      OWN_LINKS(slot, b) {
        above[slot] = Model::above(Model::LINKS * round + (b < Model::LINKS ? b : 0));
        others[slot] = of_link(own, above[slot]);
      }
      OWN_LINKS(slot, b) if (above[slot] >= 0) own[slot] = own[slot] + others[slot];
    }
  }
  INLINE void place_in_world(LocalPose* own) const {
    if (LANES == 1) {
      for (int b = 0; b < Model::LINKS; ++b)
        if (Model::parent(b) >= 0) own[b] = own[b].after(own[Model::parent(b)]);
      return;
    }
    ROLLED for (int round = 0; round < Model::ROUNDS; ++round) {
      LocalPose others[LINK_SLOTS];
      int above[LINK_SLOTS];
      OWN_LINKS(slot, b) {
        above[slot] = Model::above(Model::LINKS * round + (b < Model::LINKS ? b : 0));
        others[slot] = of_link(own, above[slot]);
      }
      OWN_LINKS(slot, b) if (above[slot] >= 0) own[slot] = own[slot].after(others[slot]);
    }
  }

  INLINE Vec qpos_vec(int i) const { return {w.qpos[i], w.qpos[i + 1], w.qpos[i + 2]}; }
  INLINE Quat qpos_quat(int i) const {
    return Quat{w.qpos[i], w.qpos[i + 1], w.qpos[i + 2], w.qpos[i + 3]}.normalized();
  }

  // The pose of a link relative to its parent; leaves axes and anchors of hinges and slides in the parent's frame.
  INLINE LocalPose local_pose(int link) {
    Vec position = Model::link_position(link);
    Quat orientation = Model::link_orientation(link);
    const int end = Model::first_joint(link + 1);
    ROLLED for (int j = Model::first_joint(link); j < end; ++j) {
      const int q = Model::joint_qpos(j), kind = Model::joint_kind(j);
      if (Model::HAS_FREE && kind == FREE) {
        position = qpos_vec(q);
        orientation = qpos_quat(q + 3);
        continue;
      }
      const Vec offset = Model::joint_position(j);
      const Vec anchor = Model::JOINTS_ASIDE ? position + orientation.rotate(offset) : position;
      if (Model::HAS_BALL && kind == BALL) {
        orientation = orientation * qpos_quat(q);
      } else {
        const Vec axis = Model::joint_axis(j), direction = Model::JOINTS_TURNED ? orientation.rotate(axis) : axis;
        const float displacement = w.qpos[q] - Model::joint_qpos0(j);
        w.axes[Model::joint_dof(j)] = {direction, anchor};
        if (Model::HAS_SLIDE && kind == SLIDE_JOINT) {
          position = position + direction * displacement;
          continue;
        }
        float sine, cosine;
        sincos(0.5f * displacement, sine, cosine);
        const Quat turn = {cosine, sine * axis.x, sine * axis.y, sine * axis.z};
        orientation = Model::JOINTS_TURNED ? orientation * turn : turn;
      }
      if (Model::JOINTS_ASIDE) position = anchor - orientation.rotate(offset);
    }
    return {orientation, position};
  }

  INLINE Pose pose_of(int link) const {
    if (link < 0) return {{{1.0f, 0.0f, 0.0f}, {0.0f, 1.0f, 0.0f}, {0.0f, 0.0f, 1.0f}}, {0.0f, 0.0f, 0.0f}};
    return w.pose[link];
  }

  INLINE Vec center_of_mass(int link, const Pose& pose) const {
    return pose.position + pose.orientation * Model::link_center(link);
  }

  // Poses of the links, and the centres of mass of the trees.
  INLINE void poses() {
    LocalPose own[LINK_SLOTS];
    OWN_LINKS(slot, b) own[slot] = local_pose(b < Model::LINKS ? b : 0);
    place_in_world(own);
    Vec moment = {0.0f, 0.0f, 0.0f};  // of the only tree, or of one after the other
    OWN_LINKS(slot, b) {
      if (b >= Model::LINKS) continue;
      const Pose pose = {Mat::from(own[slot].orientation), own[slot].position};
      w.pose[b] = pose;
      if (Model::TREES == 1) moment = moment + center_of_mass(b, pose) * Model::link_mass(b);
    }
    ROLLED for (int t = 0; t < Model::TREES; ++t) {
      if (Model::TREES > 1) moment = {0.0f, 0.0f, 0.0f};
      SHARED_LOOP(b, Model::TREES > 1 ? Model::LINKS : 0)
        if (Model::tree(b) == t) moment = moment + center_of_mass(b, w.pose[b]) * Model::link_mass(b);
      float total[3] = {moment.x, moment.y, moment.z};
      sum(total, 3);
      w.com[t] = (Vec{total[0], total[1], total[2]} + Model::fixed_moment(t)) * Model::inverse_mass(t);
    }
    sync();
  }

  // The motion of the tree for a unit velocity of each degree of freedom, and the velocity of each link.
  INLINE void velocities() {
    SHARED_LOOP(d, DOFS) {
      const int link = Model::dof_link(d), kind = Model::dof_kind(d), k = Model::dof_component(d);
      const Vec com = w.com[Model::tree(link)];
      Motion axis = w.axes[d];  // direction and anchor in the parent's frame
      if (kind == TRANSLATION) {
        axis = {{0.0f, 0.0f, 0.0f}, {k == 0 ? 1.0f : 0.0f, k == 1 ? 1.0f : 0.0f, k == 2 ? 1.0f : 0.0f}};
      } else if (kind == ROTATION) {
        const Pose pose = w.pose[link];
        const Vec anchor = Model::HAS_BALL ? pose.position + pose.orientation * Model::dof_anchor(d) : pose.position;
        const Vec direction = pose.orientation.column(k);
        axis = Spatial::turning(direction, com - anchor);
      } else {
        const Pose parent = pose_of(Model::parent(link));
        const Vec direction = parent.orientation * axis.angular;
        const Vec anchor = parent.position + parent.orientation * axis.linear;
        axis = Spatial::turning(direction, com - anchor);
        if (Model::HAS_SLIDE && kind == SLIDE) axis = {{0.0f, 0.0f, 0.0f}, direction};
      }
      w.axes[d] = axis;
    }
    sync();
    Motion own[LINK_SLOTS];
    OWN_LINKS(slot, b) {
      const int end = b < Model::LINKS ? Model::first_dof(b + 1) : 0;
      int d = b < Model::LINKS ? Model::first_dof(b) : 0;
      Motion velocity = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}};
      if (Model::HAS_FREE && Model::dof_kind(d) == TRANSLATION) {  // along the axes of the world
        velocity.linear = velocity.linear + Vec{w.qvel[d], w.qvel[d + 1], w.qvel[d + 2]};
        d += 3;
      }
      ROLLED for (; d < end; ++d) velocity = velocity + w.axes[d] * w.qvel[d];
      own[slot] = velocity;
    }
    sum_to_root(own);
    OWN_LINKS(slot, b) if (b < Model::LINKS) w.velocity[b] = own[slot];
    sync();
  }

  // ---- Dynamics

  // Bias forces (Coriolis, centrifugal, gravity) and inertias of the links, by recursive Newton-Euler; then both of
  // each subtree, which is all that the mass matrix needs (composite rigid bodies).
  INLINE void subtrees() {
    Motion accelerations[LINK_SLOTS];  // that the velocities cause
    OWN_LINKS(slot, link) {
      const int b = link < Model::LINKS ? link : 0, parent = Model::parent(b), end = Model::first_joint(b + 1);
      Motion velocity = {{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}}, acceleration = velocity;
      if (parent >= 0) velocity = w.velocity[parent];
      ROLLED for (int j = Model::first_joint(b); j < end; ++j) {
        int d = Model::joint_dof(j);
        const int kind = Model::joint_kind(j);
        if (Model::HAS_FREE && kind == FREE) {  // its translations have axes that do not move
          velocity.linear = velocity.linear + Vec{w.qvel[d], w.qvel[d + 1], w.qvel[d + 2]};
          d += 3;
        }
        Motion relative = w.axes[d] * w.qvel[d];
        if (Model::QUATERNIONS > 0 && kind <= BALL)
          relative = relative + w.axes[d + 1] * w.qvel[d + 1] + w.axes[d + 2] * w.qvel[d + 2];
        acceleration = acceleration + Spatial::cross_motion(velocity, relative);
        velocity = velocity + relative;
      }
      accelerations[slot] = acceleration;
    }
    sum_to_root(accelerations);
    OWN_LINKS(slot, b) {
      if (b >= Model::LINKS) continue;
      const Motion velocity = w.velocity[b];
      Motion acceleration = accelerations[slot];
      acceleration.linear = acceleration.linear - Model::gravity();
      const Pose pose = w.pose[b];
      const float mass = Model::link_mass(b);
      const Vec offset = center_of_mass(b, pose) - w.com[Model::tree(b)];
      const Inertia inertia = Spatial::moved(Model::link_inertia(b).turned(pose.orientation), mass, offset);
      const Motion momentum = Spatial::product(inertia, velocity);
      const Motion force = Spatial::product(inertia, acceleration) + Spatial::cross_force(velocity, momentum);
      w.bodies[b] = {inertia, force.angular, force.linear};
    }
    sync();
    float* const bodies = reinterpret_cast<float*>(w.bodies);
    if (LANES == 1) {
      for (int b = Model::LINKS - 1; b > 0; --b)
        if (Model::parent(b) >= 0)
          for (int i = 0; i < 16; ++i) bodies[16 * Model::parent(b) + i] += bodies[16 * b + i];
    } else if (lane < 16) {  // a lane for each of the 16 numbers of a body
      float total[Model::LINKS];
      UNROLLED for (int b = 0; b < Model::LINKS; ++b) total[b] = bodies[16 * b + lane];
      Model::add_children(total);
      UNROLLED for (int b = 0; b < Model::LINKS; ++b) bodies[16 * b + lane] = total[b];
    }
    sync();
  }

//ACTUATOR
  // Passive and actuator forces of a degree of freedom, and its damping: minus the derivative of the force by its
  // velocity. MuJoCo leaves out of that actuators whose force a limit holds.
  INLINE float joint_force(int d, float& damping) const {
    const int q = Model::dof_qpos(d);
    damping = Model::damping(d);
    float force = -damping * w.qvel[d], actuation = 0.0f;
    if (Model::HAS_SPRINGS) force = force - Model::stiffness(d) * (w.qpos[q] - Model::spring(q));
    const int end = Model::first_actuator(d + (Model::SUBSTEPS > 0));  // a step that is not taken has no actuation
    ROLLED for (int a = Model::first_actuator(d); a < end; ++a) {
      const float gear = Model::gear(a);
      const float f = actuator_force(a, ctrl[Model::control(a)], w.qpos[q], w.qvel[d]);
      if (Model::IMPLICIT_ACTUATORS && Model::force_low(a) < f && f < Model::force_high(a))
        damping = damping - gear * gear * Model::bias_velocity(a);
      if (Model::JOINT_FORCE_LIMITS) actuation = actuation + gear * f;
      else force = force + gear * f;
    }
    if (!Model::JOINT_FORCE_LIMITS) return force;
    const float low = Model::joint_force_low(d), high = Model::joint_force_high(d);
    if (!(low < actuation && actuation < high)) damping = Model::damping(d);
    return force + clamp(actuation, low, high);
  }

  // The mass matrix, and the residual: minus the smooth forces, until M qacc is added. Entries of degrees of freedom of
  // which neither is an ancestor of the other stay zero. A lane has one of the entries off the diagonal.
  INLINE void mass_matrix() {
    OWN_DOFS(slot, d) {
      if (d >= DOFS) continue;
      const Body body = w.bodies[Model::dof_link(d)];
      const Motion axis = w.axes[d], momentum = Spatial::product(body.inertia, axis), bias = {body.torque, body.force};
      w.residual[d] = axis.dot(bias) - joint_force(d, implicit_damping[slot]);
      w.mass[STRIDE * d + d] = axis.dot(momentum) + Model::armature(d);
      w.momentum[d] = momentum;
    }
    sync();
    SHARED_LOOP(i, Model::MASS_ENTRIES) {
      const unsigned entry = Model::mass_entry(i), d = entry / 64, ancestor = entry % 64;
      w.mass[STRIDE * d + ancestor] = w.mass[STRIDE * ancestor + d] = w.axes[ancestor].dot(w.momentum[d]);
    }
    sync();
  }

  // ---- Contacts. Points are relative to the centre of mass of the first tree.

  INLINE void place_geoms() {
    SHARED_LOOP(g, Model::GEOMS) {
      const Pose pose = pose_of(Model::geom_link(g));
      w.geoms[g] = {pose.position - w.com[0] + pose.orientation * Model::geom_position(g),
                    pose.orientation * Model::geom_half_axis(g), Model::geom_radius(g)};
    }
    sync();
  }

  // The deepest contacts stay: one that finds no place takes that of the shallowest. Returns the place of this lane's
  // contact, or none of them. Limits of ball joints, which come first and always find a place, are not displaced.
  INLINE int make_room(bool touches, Contact* stored, int place, int places, int id, float depth) const {
    if (touches && place < places) {
      stored[place].distance = depth;
      stored[place].id = id;
    }
    sync();
    ROLLED for (unsigned late = ballot(touches && place >= places); late; late &= late - 1) {
      const int from = lowest_bit(late);
      const float new_depth = read(depth, from);
      float shallowest = -1e30f;
      int at = places;
      SHARED_LOOP(i, places) {
        if (stored[i].distance <= shallowest || (Model::BALL_LIMITS && stored[i].pair() >= Model::PAIRS)) continue;
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
  INLINE void add_contact(bool touches, const bool friction, int pair, int number, Vec point, float distance,
                          Vec normal, Vec hint) {
    const int id = pair << POINT_BITS | number;
    const int left = Model::JACOBIAN_ROWS - DIRECTIONS * frictional;
    const int places = friction ? Model::FRICTIONAL : left < Model::FRICTIONLESS ? left : Model::FRICTIONLESS;
    int& count = friction ? frictional : frictionless;
    const unsigned hits = ballot(touches);
    int place = count + bits(hits & lanes_below());
    count += bits(hits);
    if (count > places) {
      count = places;
      flag(NO_PLACE);
      place = make_room(touches, w.contacts + (friction ? 0 : Model::FRICTIONAL), place, places, id,
                        distance - Model::margin(pair));
    }
    if (!touches || place >= places) return;
    w.contacts[friction ? place : Model::FRICTIONAL + place] = {point, distance - Model::margin(pair), normal, id};
    if (!friction) return;
    w.tangents[place] = Frame::tangent(normal, hint, Model::least_aligned());
  }

  // Spheres and the ends of capsules against planes of the world.
  INLINE void collide_with_planes(const int begin, const int end, const bool friction) {
    ROLLED for (int base = begin; base < end; base += LANES) {
      const bool valid = base + lane < end;
      const int pair = valid ? base + lane : begin;
      const Geom geom = w.geoms[Model::second_geom(pair)];
      const Vec normal = Model::plane_normal(pair);
      const float height = normal.dot(geom.center) + normal.dot(w.com[0]) - Model::plane_offset(pair) - geom.radius;
      const float rise = normal.dot(geom.half_axis), inverse_half = Model::inverse_half_length(pair);
      ROLLED for (int side = 0; side < 2; ++side) {
        const float sign = side ? -1.0f : 1.0f, distance = height + sign * rise;
        const bool exists = valid && (side == 0 || inverse_half > 0.0f);
        add_contact(exists && distance < Model::margin(pair), friction, pair, side,
                    geom.center + geom.half_axis * sign - normal * (geom.radius + 0.5f * distance), distance, normal,
                    geom.half_axis * inverse_half);
      }
    }
  }

//IF SOLIDS
  INLINE Mat geom_axes(int g) const {  // by rows
    const Mat link = pose_of(Model::geom_link(g)).orientation, own = Model::geom_orientation(g);
    if (!Model::SOLIDS_TURNED) return link;
    return {own.transposed_times(link.row0), own.transposed_times(link.row1), own.transposed_times(link.row2)};
  }

//IF MESHES
  struct Corner { int vertex, corner; };  // of a mesh; the corner is that of a face, or -1

  // The lowest vertex of a mesh over a plane with normal n, and its corner of the face that is most parallel to it.
  static INLINE Corner lowest_corner(int g, Vec n) {
    Corner lowest = {Model::first_vertex(g), -1};
    const int end = Model::last_vertex(g);
    float least = 1e30f;
    ROLLED for (int i = lowest.vertex; i < end; ++i) {
      const float height = n.dot(Model::vertex(i));
      if (!(height < least)) continue;
      least = height;
      lowest.vertex = i;
    }
    float facing = 1.0f;
    const int last = Model::first_corner(lowest.vertex + 1);
    ROLLED for (int i = Model::first_corner(lowest.vertex); i < last; ++i) {
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

//END
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
  INLINE void collide_solids_with_planes(const int begin, const int end, const bool friction) {
    ROLLED for (int base = begin; base < end; base += LANES) {
      const bool valid = base + lane < end;
      const int pair = valid ? base + lane : begin, g = Model::second_geom(pair);
      const Geom geom = w.geoms[g];
      const Vec normal = Model::plane_normal(pair);
      const float height = normal.dot(geom.center) + normal.dot(w.com[0]) - Model::plane_offset(pair);
      const bool near = valid && height - geom.radius < Model::margin(pair);
      if (!ballot(near)) continue;
      const Mat axes = geom_axes(g);
      const Vec n = axes.transposed_times(normal);
//IF MESHES
      const bool is_mesh = near && Model::geom_shape(g) == MESH;
      const Corner lowest = is_mesh ? lowest_corner(g, n) : Corner{0, -1};
//END
      ROLLED for (int k = 0; k < 4; ++k) {
        Vec point;
//IF MESHES
        const bool exists = is_mesh ? vertex_below(lowest, k, n, point) : point_below(g, k, n, point);
//ELSE
        const bool exists = point_below(g, k, n, point);
//END
        const float distance = height + n.dot(point);
        add_contact(near && exists && distance < Model::margin(pair), friction, pair, k,
                    geom.center + axes * point - normal * (0.5f * distance), distance, normal, {0.0f, 0.0f, 0.0f});
      }
    }
  }

//END
  // Lists the pairs of moving geoms whose bounding spheres are within their margin, in their order, and returns how many
  // there are. A pair is one number: the square of what is within, with the geoms in its lowest bits.
  INLINE int near_pairs() {
    enum { ROUNDS = LANES > 1 ? Model::NEAR_ROUNDS : 1 };  // side by side, as few find a pair
    const unsigned geom = (1u << Model::GEOM_BITS) - 1;
    int count = 0;
    ROLLED for (int base = Model::SOLID_END; base < Model::PAIRS; base += ROUNDS * LANES) {
      unsigned near = 0;
      UNROLLED for (int k = 0; k < ROUNDS; ++k) {
        const unsigned pair = Model::near_pair(base - Model::SOLID_END + LANES * k + lane);
        const Vec between = w.geoms[pair & geom].center - w.geoms[pair >> Model::GEOM_BITS & geom].center;
        if (between.dot(between) < from_bits(pair)) near |= 1u << k;
      }
      if (!ballot(near)) continue;
      ROLLED for (int k = 0; k < ROUNDS; ++k) {
        const bool own = near >> k & 1;
        const unsigned hits = ballot(own);
        if (own) w.candidates[count + bits(hits & lanes_below())] = (unsigned short)(base + LANES * k + lane);
        count += bits(hits);
      }
    }
    sync();
    return count;
  }

  // This lane's pair of those that are listed from `at` on, up to pair `end`; `at` moves on by all that the lanes have.
  struct Listed { int pair; bool valid; };
  INLINE Listed listed(int& at, const int count, const int end) const {
    const int pair = at + lane < count ? w.candidates[at + lane] : end;
    const bool valid = pair < end;
    at += bits(ballot(valid));
    return {valid ? pair : Model::SOLID_END, valid};
  }

  // Spheres and capsules against each other: the nearest points of the two segments.
  INLINE void collide_geoms(int& at, const int count, const int begin, const int end, const bool friction) {
    if (begin == end) return;
    ROLLED for (; at < count && w.candidates[at] < end;) {
      const Listed own = listed(at, count, end);
      const int pair = own.pair;
      const Geom a = w.geoms[Model::first_geom(pair)], b = w.geoms[Model::second_geom(pair)];
      const Segment first = {a.center - a.half_axis, a.half_axis * 2.0f};
      const Segment second = {b.center - b.half_axis, b.half_axis * 2.0f};
      const Nearest nearest = Nearest::of(first, second);
      ROLLED for (int i = 0; i < 2; ++i) {
        const Vec point = first.at(i ? nearest.first[1] : nearest.first[0]);
        const Vec gap = second.at(i ? nearest.second[1] : nearest.second[0]) - point;
        float length;
        const Vec normal = Frame::normal(gap, first.along, second.along, length);
        const float distance = length - (a.radius + b.radius);
        add_contact(own.valid && i < nearest.points && distance < Model::margin(pair), friction, pair, i,
                    point + normal * (a.radius + 0.5f * distance), distance, normal, {0.0f, 0.0f, 0.0f});
      }
    }
  }

//IF BOXES
  // ---- Spheres and capsules against boxes, in the frame of the box

  struct Depth { float distance; Vec normal, point; };

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
    ROLLED for (int face = 0; face < 6; ++face) {
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

  struct Ends { float first, second; int points; };  // on a capsule's segment, in half axes from its center

  // The point of a capsule's segment that is nearest to a box; and if the capsule lies along a face or an edge, the
  // point up to which it does. The choices, and their order where several are as near, are MuJoCo's.
  static INLINE Ends capsule_and_box(Vec center, Vec half, Vec size) {
    const float length_squared = half.dot(half);
    float nearest = 1e30f, at = 0.0f, on_edge = 0.0f;
    int face = -1, edge = -1, side = 1, corner = 0;
    ROLLED for (int end = 0; end < 2; ++end) {  // an end that is beyond one face, or inside
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
    ROLLED for (int e = 0; e < 12; ++e) {  // a point between the ends, or the end of an edge
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
      ROLLED for (int i = 0; i < 6; ++i) {
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

  INLINE void collide_boxes(int& at, const int count, const int begin, const int end, const bool friction) {
    if (begin == end) return;
    ROLLED for (; at < count && w.candidates[at] < end;) {
      const Listed own = listed(at, count, end);
      const int pair = own.pair, g = Model::second_geom(pair);
      const Geom geom = w.geoms[Model::first_geom(pair)];
      const Vec origin = w.geoms[g].center, size = Model::geom_size(g);
      const Mat axes = geom_axes(g);
      const Vec center = axes.transposed_times(geom.center - origin), half = axes.transposed_times(geom.half_axis);
      const float reach = geom.radius + Model::margin(pair);
      // Bounding spheres of a trunk hold its legs. Most are clear of one of its faces, nearly all others along a normal of
      // an edge and the capsule, of length root(width). Rounding does not decide, as the exact test follows.
      bool near = own.valid;
      UNROLLED for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3, k = (i + 2) % 3;
        near = near && fabsf(center.component(i)) - fabsf(half.component(i)) < size.component(i) + reach;
        const float y = half.component(j), z = half.component(k), width = y * y + z * z;
        const float apart = fabsf(center.component(j) * z - center.component(k) * y) -
                            (size.component(j) * fabsf(z) + size.component(k) * fabsf(y));
        near = near && !(apart > 0.0f && apart * apart > 1.001f * reach * reach * width);
      }
      if (!ballot(near)) continue;
      const Ends ends = half.dot(half) > MINVAL ? capsule_and_box(center, half, size) : Ends{0.0f, 0.0f, 1};
      ROLLED for (int i = 0; i < 2; ++i) {
        const Depth depth = sphere_and_box(center + half * (i ? ends.second : ends.first), geom.radius, size);
        add_contact(near && i < ends.points && depth.distance < Model::margin(pair), friction, pair, i,
                    origin + axes * depth.point, depth.distance, axes * depth.normal, {0.0f, 0.0f, 0.0f});
      }
    }
  }

//END
  // The limit of a ball joint is a row along three degrees of freedom; it lies among the contacts without friction.
  INLINE void limit_balls() {
    ROLLED for (int base = 0; base < Model::BALL_LIMITS; base += LANES) {
      const bool valid = base + lane < Model::BALL_LIMITS;
      const int i = valid ? base + lane : 0, pair = Model::PAIRS + i;
      float angle;
      const Vec axis = qpos_quat(Model::ball_qpos(i)).axis(angle);
      const float distance = Model::ball_range(i) - angle;
      add_contact(valid && distance < Model::margin(pair), false, pair, 0, {0.0f, 0.0f, 0.0f}, distance, axis * -1.0f,
                  {0.0f, 0.0f, 0.0f});
    }
  }

  INLINE void find_contacts() {
    frictional = frictionless = 0;
    if (Model::GEOMS > 0) place_geoms();
    const int count = Model::PAIRS > Model::SOLID_END ? near_pairs() : 0;
    int at = 0;  // in the list
    // Those with friction, then those without, by one text.
    ROLLED for (int kind = 0; kind < 2; ++kind) {
      const bool friction = kind == 0;
      if (!friction) limit_balls();
      collide_with_planes(friction ? 0 : Model::SOLID_FRICTIONAL_END,
                          friction ? Model::PLANE_FRICTIONAL_END : Model::PLANE_END, friction);
//IF SOLIDS
      collide_solids_with_planes(friction ? Model::PLANE_FRICTIONAL_END : Model::PLANE_END,
                                 friction ? Model::SOLID_FRICTIONAL_END : Model::SOLID_END, friction);
//END
      collide_geoms(at, count, friction ? Model::SOLID_END : Model::BOX_FRICTIONAL_END,
                    friction ? Model::GEOM_FRICTIONAL_END : Model::GEOM_END, friction);
//IF BOXES
      collide_boxes(at, count, friction ? Model::GEOM_FRICTIONAL_END : Model::GEOM_END,
                    friction ? Model::BOX_FRICTIONAL_END : Model::BOX_END, friction);
//END
    }
    sync();
    if (Model::TOUCH) feel_contacts();
    sync();
  }

  // ---- Constraint rows

  // Contacts with friction come first, then those without, each from a place of its own.
  INLINE int place_of(int i) const { return i < frictional ? i : Model::FRICTIONAL + i - frictional; }
  INLINE const Contact& contact(int i) const { return w.contacts[place_of(i)]; }

  // The second tangent of a contact, times friction.
  INLINE Vec second_tangent(Vec normal, Vec first, int pair) const {
    return normal.cross(first) * Model::friction_ratio(pair);
  }

  // Those of the contact whose number is the lane's.
  INLINE unsigned own_quads(const Contact* contacts, const int count) const {
    return SKIPS_QUADS && lane < count ? Model::quads(contacts[lane].pair()) : ~0u;
  }

  INLINE void jacobians() {
    frictional_quads = own_quads(w.contacts, frictional);
    frictionless_quads = own_quads(w.contacts + Model::FRICTIONAL, frictionless);
    Motion axes[SLOTS];
    OWN_DOFS(slot, d) axes[slot] = w.axes[d < DOFS ? d : 0];
    sync();  // rows are set up in their place
    const bool own = Model::VARIED && LANES > 1 && Model::FRICTIONAL <= LANES;
    float own_friction = 0.0f;  // of the lane's contact: in the loop, all would wait for one after the other
    if (own && lane < frictional) own_friction = Model::friction(w.contacts[lane].pair());
//IF LIMBS
    crossing = false;
//END
    ROLLED for (int i = 0; i < frictional + frictionless; ++i) {
      const Contact c = contact(i);
      const bool friction = i < frictional, ball = c.pair() >= Model::PAIRS;
      const int pair = ball ? 0 : c.pair();
//IF LIMBS
      crossing = crossing || (!ball && Model::crosses(pair));
//END
      const Model::Dofs against = Model::first_dofs(pair), with = Model::second_dofs(pair);
      Vec tangent = {0.0f, 0.0f, 0.0f}, other = tangent;
      if (friction) {
        tangent = w.tangents[i] * (own ? read(own_friction, i) : Model::friction(pair));
        other = second_tangent(c.normal, tangent, pair);
      }
//IF TURNING
      const Vec twist = c.normal * Model::torsional(pair);
      const Vec roll = w.tangents[friction ? i : 0] * Model::rolling(pair);
      const Vec other_roll = c.normal.cross(roll) * Model::rolling_ratio(pair);
//END
      float* const row = w.jacobian + STRIDE * (friction ? DIRECTIONS * i : (DIRECTIONS - 1) * frictional + i);
      OWN_DOFS(slot, d) {
        if (d >= STRIDE) continue;
        Vec point = c.point;
        if (Model::TREES > 1) point = point + w.com[0] - w.com[Model::tree(Model::dof_link(d < DOFS ? d : 0))];
        Vec velocity = axes[slot].linear + axes[slot].angular.cross(point);
        const float sign = d < DOFS ? (float)((int)(with >> d & 1) - (int)(against >> d & 1)) : 0.0f;
        velocity = velocity * sign;
        if (Model::BALL_LIMITS && ball) {
          const int k = d - Model::ball_dof(c.pair() - Model::PAIRS);
          row[d] = k >= 0 && k < 3 ? c.normal.component(k) : 0.0f;
          continue;
        }
        row[d] = velocity.dot(c.normal);
        if (friction) {
          row[STRIDE + d] = velocity.dot(tangent);
          row[2 * STRIDE + d] = velocity.dot(other);
//IF TURNING
          const Vec angular = axes[slot].angular * sign;
          row[3 * STRIDE + d] = angular.dot(twist);
          if (DIRECTIONS == 4) continue;
          row[4 * STRIDE + d] = angular.dot(roll);
          row[5 * STRIDE + d] = angular.dot(other_roll);
//END
        }
      }
    }
  }

  // A row from the inverse inertia along it and how far it is violated. Velocity and acceleration follow.
  INLINE void set_row(int r, Softness softness, float inverse_inertia, float position, float least) {
    softness.row(inverse_inertia, position, least, w.weight[r], w.x[r]);
  }

  INLINE int contact_of_row(int r) const {
    return r < first_frictionless() ? r / CONTACT_ROWS : r - (CONTACT_ROWS - 1) * frictional;
  }

  INLINE void set_rows() {
    SHARED_LOOP(r, first_limit()) {
      const Contact& c = contact(contact_of_row(r));
//IF ELLIPTIC
      if (r < first_frictionless() && r % CONTACT_ROWS > 0) {  // nothing is violated off the normal
        w.weight[r] = Model::mu(c.pair());
        w.x[r] = 0.0f;
        continue;
      }
//END
//IF SOME_LACK_EDGES
      if (r < first_frictionless() && r % CONTACT_ROWS >= Model::edges(c.pair())) {  // so far open that it stays so
        w.weight[r] = 0.0f;
        w.x[r] = 1e15f;
        continue;
      }
//END
      set_row(r, Model::contact_softness(c.pair()), Model::inverse_inertia(c.pair()), c.distance,
              Model::least_regularisation(c.pair()));
    }
    limits = 0;
    OWN_DOFS(slot, d) UNROLLED for (int side = 0; side < Model::LIMIT_SIDES; ++side) {
      limit_row[side][slot] = -1;
      if (Model::LIMITS == 0) continue;
      const int e = d < DOFS ? d : 0;
      const float q = w.qpos[Model::dof_qpos(e)], below = q - Model::limit_low(e), above = Model::limit_high(e) - q;
      const bool upper = Model::LIMIT_SIDES == 2 ? side : !(below < above);  // the nearer one, if there is one row
      const float position = (upper ? above : below) - Model::limit_margin(e);
      const bool violated = d < DOFS && position < 0.0f;
      const unsigned hits = ballot(violated);
      if (violated) {
        const int i = limits + bits(hits & lanes_below()), r = limit_row[side][slot] = first_limit() + i;
        w.limits[i] = (unsigned char)(upper ? d + 128 : d);
        set_row(r, Model::limit_softness(d), Model::limit_inverse_inertia(d), position, MINVAL);
      }
      limits += bits(hits);
    }
    SHARED_LOOP(i, Model::FRICTION_LOSSES) {
      w.weight[first_friction() + i] = Model::friction_weight(i);
      w.x[first_friction() + i] = 0.0f;
    }
    sync();
  }

  INLINE float row_damping(int r) const {  // of a row without a contact
    if (r < first_friction()) return Model::limit_softness(w.limits[r - first_limit()] & 127).damping;
    return Model::friction_damping(Model::FRICTION_LOSSES ? r - first_friction() : 0);
  }

  // Row r of J times a vector, of whose products with the rows of the Jacobian w.projected has those of the contacts.
  INLINE float row_velocity(int r, const float* vector) const {
    if (!Model::ELLIPTIC && r < first_frictionless()) {  // edges of a pyramid: the normal, plus or minus another
      const float* const p = w.projected + DIRECTIONS * (r / CONTACT_ROWS);
      const float other = p[1 + (unsigned)r % CONTACT_ROWS / 2];
      return r & 1 ? p[0] - other : p[0] + other;
    }
    if (r < first_limit()) return w.projected[r - (CONTACT_ROWS - DIRECTIONS) * frictional];
    if (r < first_friction()) {
      const int limit = w.limits[r - first_limit()];
      return limit < 128 ? vector[limit] : -vector[limit - 128];
    }
    return vector[Model::friction_dof(Model::FRICTION_LOSSES ? r - first_friction() : 0)];
  }

  // The sides on which a contact with friction is, and its law there, at the residuals of now. The first of its rows has the
  // weight of all; of a cone, the second has mu.
  INLINE unsigned sides_of(int contact) const {
    const float* const x = w.x + CONTACT_ROWS * contact;
//IF ELLIPTIC
    return Cone::state(x, w.weight[CONTACT_ROWS * contact + 1]);
//ELSE
    return Pyramid::sides(x);
//END
  }
  INLINE Law law(int contact, unsigned sides) const {
    const float *const x = w.x + CONTACT_ROWS * contact, *const weight = w.weight + CONTACT_ROWS * contact;
//IF ELLIPTIC
    return Law(x, weight[0], weight[1], sides);
//ELSE
    float edges[CONTACT_ROWS];
    UNROLLED for (int i = 0; i < CONTACT_ROWS; ++i) edges[i] = CONTACT_ROWS == 4 ? read4(x).v[i & 3] : x[i];
    return Law(edges, weight[0], sides);
//END
  }
  INLINE Law law(int contact) const { return law(contact, sides_of(contact)); }

  INLINE bool has_friction(int own) const { return own < OWN_FRICTIONAL; }
  INLINE int number(int own, int lane) const { return lane + LANES * (has_friction(own) ? own : own - OWN_FRICTIONAL); }
  INLINE int number(int own) const { return number(own, lane); }
  INLINE bool exists(int own) const { return number(own) < (has_friction(own) ? frictional : frictionless); }
  // The sides of an own contact, 0 if it is open, or none: as they are taken, and as they are.
  INLINE unsigned sides(int own) const { return contact_sides[own] & ((1u << SIDE_BITS) - 1); }
  INLINE unsigned sides_now(int own) const {
    if (!exists(own)) return 0;
    return has_friction(own) ? sides_of(number(own)) : (unsigned)(w.x[first_frictionless() + number(own)] < 0.0f);
  }
  INLINE LimitSide limit_side_now(int row) const { return row < 0 ? NO_LIMIT : w.x[row] < 0.0f ? CLOSED : OPEN; }

  // Takes contacts and limits to be where they were at the end of the substep before, which is right more often than what
  // its acceleration says now; what is new, where it is. Returns whether some are elsewhere now.
  INLINE bool guess_sides() {
    bool differs = false;
    unsigned found[CONTACT_SLOTS];
    OWN_PLACES(own, 0, CONTACT_SLOTS) {
      const bool friction = has_friction(own);
      const unsigned now = sides_now(own);
      const unsigned id = exists(own) ? w.contacts[number(own) + (friction ? 0 : Model::FRICTIONAL)].id : NO_CONTACT;
      found[own] = id << SIDE_BITS | now;
      int left = !GUESSES ? 0 : friction ? frictional_before : frictionless_before;
      OWN_PLACES(slot, friction ? 0 : OWN_FRICTIONAL, friction ? OWN_FRICTIONAL : CONTACT_SLOTS) {
        const int some = left < LANES ? left : LANES;
        ROLLED for (int from = 0; from < some; ++from) {
          const unsigned before = read(contact_sides[slot], from);
          if (before >> SIDE_BITS == id) found[own] = before;
        }
        left -= some;
      }
      differs = differs || (found[own] ^ now) << (32 - SIDE_BITS);
    }
    OWN_PLACES(own, 0, CONTACT_SLOTS) contact_sides[own] = found[own];
    OWN_DOFS(slot, d) UNROLLED for (int side = 0; side < Model::LIMIT_SIDES; ++side) {
      const LimitSide now = limit_side_now(limit_row[side][slot]), before = limit_sides[side][slot];
      limit_sides[side][slot] = GUESSES && now != NO_LIMIT && before != NO_LIMIT ? before : now;
      differs = differs || limit_sides[side][slot] != now;
    }
    frictional_before = frictional;
    frictionless_before = frictionless;
    return ballot(differs) != 0;
  }

  // Takes contacts and limits to be where they are, and returns whether some were elsewhere, or nowhere on a parabola.
  INLINE bool find_sides() {
    bool differs = false;
    OWN_PLACES(own, 0, CONTACT_SLOTS) {
      const unsigned now = sides_now(own);
      differs = differs || now != sides(own);
//IF ELLIPTIC
      differs = differs || (has_friction(own) && now == Cone::SLIDING);
//END
      contact_sides[own] = contact_sides[own] >> SIDE_BITS << SIDE_BITS | now;
    }
    OWN_DOFS(slot, d) UNROLLED for (int side = 0; side < Model::LIMIT_SIDES; ++side) {
      const LimitSide now = limit_side_now(limit_row[side][slot]);
      differs = differs || now != limit_sides[side][slot];
      limit_sides[side][slot] = now;
    }
    return differs;
  }

  // ---- Newton's method

  struct Slots {  // of the Hessian (or of M + h D): the rows that this lane owns
    float row[SLOTS][STRIDE];
    float diagonal[SLOTS], gradient[SLOTS];  // what has yet to be added to the diagonal; the right-hand side
    float whole[SLOTS];                      // the diagonal, if DELICATE
  };

  static INLINE Quad read4(const float* p) { return *reinterpret_cast<const Quad*>(p); }
  static INLINE void write4(float* p, Quad q) { *reinterpret_cast<Quad*>(p) = q; }

  // What acts on a degree of freedom alone: its residual, limits and dry friction; and instead, in the end, what implicit
  // damping adds: (M + h D) a = M qacc, solved for the difference of a and qacc.
  INLINE void own_terms(const bool damping_alone, const float regularisation, float* diagonal, float* gradient) const {
    OWN_DOFS(slot, d) {
      diagonal[slot] = Model::DELICATE && d < DOFS ? regularisation * w.mass[STRIDE * d + d] : 0.0f;
      gradient[slot] = d < DOFS ? w.residual[d] : 0.0f;
      if (damping_alone) {
        const float damping = Model::IMPLICIT_ACTUATORS ? implicit_damping[slot] : Model::damping(d < DOFS ? d : 0);
        diagonal[slot] = d < DOFS ? Model::timestep() * damping : 0.0f;
        gradient[slot] = d < DOFS ? diagonal[slot] * w.qacc[d] : 0.0f;
        continue;
      }
      UNROLLED for (int side = 0; side < Model::LIMIT_SIDES; ++side) {
        const int r = limit_row[side][slot];
        if (r < 0) continue;
        const float weight = limit_sides[side][slot] == CLOSED ? w.weight[r] : 0.0f, push = weight * w.x[r];
        diagonal[slot] += weight;
        gradient[slot] += w.limits[r - first_limit()] < 128 ? push : -push;
      }
      const int loss = Model::friction_row(d < DOFS ? d : 0);
      if (Model::FRICTION_LOSSES && d < DOFS && loss >= 0) {
        const int r = first_friction() + loss;
        const float bound = Model::friction_bound(loss);
        diagonal[slot] += DryFriction::curvature(w.x[r], w.weight[r], bound);
        gradient[slot] += DryFriction::gradient(w.x[r], w.weight[r], bound);
      }
    }
  }

  INLINE void start_from_mass(Slots& h) const {
    OWN_DOFS(slot, d) {
      const int e = d < DOFS ? d : DOFS - 1;
      if (Model::DELICATE) h.whole[slot] = w.mass[STRIDE * e + e] + h.diagonal[slot];
      UNROLLED for (int i = 0; i < QUADS; ++i) {
        if (4 * i >= LANES * (slot + 1)) break;
        const Quad m = read4(w.mass + STRIDE * e + 4 * i);
        UNROLLED for (int k = 0; k < 4; ++k) h.row[slot][4 * i + k] = m.v[k];
      }
    }
  }

  // J' D J over the active rows of contacts, and their gradient.
  INLINE void add_contacts(Slots& h) const {
    CLOSED_CONTACTS(place, left, 0, OWN_FRICTIONAL) {
      const int from = lowest_bit(left), k = number(place, from);
      const Law cost = law(k, agreed(sides(place), from));
      const float* const rows = w.jacobian + DIRECTIONS * STRIDE * k;
      const unsigned quads = SKIPS_QUADS ? agreed(frictional_quads, k) : ~0u;
      OWN_DOFS(slot, dof) {
        if (SKIPS_QUADS && slot > 0 && !(quads >> LANES / 4 * slot)) break;
        const int e = dof < STRIDE ? dof : STRIDE - 1;
        float own[DIRECTIONS], c[DIRECTIONS];
        UNROLLED for (int i = 0; i < DIRECTIONS; ++i) own[i] = rows[STRIDE * i + e];
        cost.times(own, c);
        bool some = false;
        UNROLLED for (int i = 0; i < DIRECTIONS; ++i) {
          h.gradient[slot] = h.gradient[slot] + cost.gradient[i] * own[i];
          if (Model::DELICATE) h.whole[slot] = h.whole[slot] + c[i] * own[i];
          some = some || c[i] != 0.0f;
        }
        if (LANES == 1 && !some) continue;
        UNROLLED for (int i = 0; i < QUADS; ++i) {
          if (4 * i >= LANES * (slot + 1)) break;
          if (SKIPS_QUADS && !(quads >> i & 1)) continue;
          Quad columns[DIRECTIONS];
          UNROLLED for (int l = 0; l < DIRECTIONS; ++l) columns[l] = read4(rows + STRIDE * l + 4 * i);
          UNROLLED for (int j = 0; j < 4; ++j)
            UNROLLED for (int l = 0; l < DIRECTIONS; ++l)
              h.row[slot][4 * i + j] = h.row[slot][4 * i + j] + c[l] * columns[l].v[j];
        }
      }
    }
    CLOSED_CONTACTS(place, left, OWN_FRICTIONAL, CONTACT_SLOTS) {
      const int k = number(place, lowest_bit(left));
      const float x = w.x[first_frictionless() + k], weight = w.weight[first_frictionless() + k];
      const float* n = w.jacobian + STRIDE * (DIRECTIONS * frictional + k);
      const unsigned quads = SKIPS_QUADS ? agreed(frictionless_quads, k) : ~0u;
      OWN_DOFS(slot, dof) {
        if (SKIPS_QUADS && slot > 0 && !(quads >> LANES / 4 * slot)) break;
        const float n0 = n[dof < STRIDE ? dof : STRIDE - 1], c = weight * n0;
        h.gradient[slot] += c * x;
        if (Model::DELICATE) h.whole[slot] += c * n0;
        if (LANES == 1 && c == 0.0f) continue;
        UNROLLED for (int i = 0; i < QUADS; ++i) {
          if (4 * i >= LANES * (slot + 1)) break;
          if (SKIPS_QUADS && !(quads >> i & 1)) continue;
          const Quad a = read4(n + 4 * i);
          UNROLLED for (int j = 0; j < 4; ++j) h.row[slot][4 * i + j] += c * a.v[j];
        }
      }
    }
  }

  // A symmetric matrix of four rows, [A B'; B C]: the factors of A - B' C^-1 B and of C, and C^-1 B.
  struct Block {
    float upper[3], mixed[2][2], lower[3];

    // [a b; b c] = L' D L, as the inverse of D, with the entry of L between its two. An inverse by the determinant takes
    // one division less, but cancels where stiff contacts couple hinges.
    static INLINE void factor_two(const float a, const float b, const float c, float* f) {
      f[2] = inverse(c);
      f[1] = b * f[2];
      f[0] = inverse(a - b * f[1]);
    }
    static INLINE void solve_two(const float* f, const float y0, const float y1, float& x0, float& x1) {
      x0 = (y0 - f[1] * y1) * f[0];
      x1 = y1 * f[2] - f[1] * x0;
    }
    INLINE void factor(const Quad* rows, const Quad damping) {
      const float *const b = rows[2].v, *const c = rows[3].v;
      factor_two(b[2] + damping.v[2], c[2], c[3] + damping.v[3], lower);
      UNROLLED for (int j = 0; j < 2; ++j) solve_two(lower, b[j], c[j], mixed[0][j], mixed[1][j]);
      factor_two(rows[0].v[0] + damping.v[0] - mixed[0][0] * b[0] - mixed[1][0] * c[0],
                 rows[1].v[0] - mixed[0][1] * b[0] - mixed[1][1] * c[0],
                 rows[1].v[1] + damping.v[1] - mixed[0][1] * b[1] - mixed[1][1] * c[1], upper);
    }
    INLINE void solve(const float* y, float* x) const {
      solve_two(upper, y[0] - mixed[0][0] * y[2] - mixed[1][0] * y[3], y[1] - mixed[0][1] * y[2] - mixed[1][1] * y[3],
                x[0], x[1]);
      solve_two(lower, y[2], y[3], x[2], x[3]);
      UNROLLED for (int i = 0; i < 2; ++i) x[2 + i] = x[2 + i] - mixed[i][0] * x[0] - mixed[i][1] * x[1];
    }
    INLINE void write(float* p) const {
      write4(p, {upper[0], upper[1], upper[2], lower[0]});
      write4(p + 4, {mixed[0][0], mixed[0][1], mixed[1][0], mixed[1][1]});
      write4(p + 8, {lower[1], lower[2], 0.0f, 0.0f});
    }
    INLINE void read(const float* p) {
      const Quad a = read4(p), b = read4(p + 4), c = read4(p + 8);
      UNROLLED for (int i = 0; i < 3; ++i) upper[i] = a.v[i];
      UNROLLED for (int i = 0; i < 4; ++i) mixed[i / 2][i % 2] = b.v[i];
      lower[0] = a.v[3];
      lower[1] = c.v[0];
      lower[2] = c.v[1];
    }
  };

  // The owners of a block hand its rows, up to a quad of columns, to all lanes.
  INLINE void hand_over(const Slots& h, const int slot, const int block, const int quads) {
    const int d = lane + LANES * slot;
    if (d >> 2 != block || d >= DOFS) return;
    UNROLLED for (int i = 0; i <= quads; ++i) {
      const float* const own = h.row[slot] + 4 * i;
      write4(w.pivots[d & 3] + 4 * i, {own[0], own[1], own[2], own[3]});
    }
    w.pivot_damping[d & 3] = h.diagonal[slot];
    w.pivot_gradient[d & 3] = h.gradient[slot];
  }

  // Eliminates blocks `first` down to `last` + 1 of four rows each, H = L D L': the owners of a block hand its rows to
  // all lanes, which subtract them from their own rows, except for columns in which they are zero: those of branches
  // of the tree that do not meet. The right-hand side, here minus the gradient, is carried along like a column.
  INLINE void eliminate(Slots& h, const int first, const int last) {
    hand_over(h, 4 * first / LANES, first, first);
    ROLLED for (int block = first;; --block) {
      sync();
      Quad rows[4];
      UNROLLED for (int i = 0; i < 4; ++i) rows[i] = read4(w.pivots[i] + 4 * block);
      Block b;
      b.factor(rows, read4(w.pivot_damping));
      if (lane == 0) b.write(w.blocks[block]);
      if (block == 0) break;
      const Quad gradient = read4(w.pivot_gradient);
      float c[SLOTS][4];
      unsigned columns[SLOTS];
      OWN_DOFS(slot, d) {
        if (4 * first <= LANES * slot) break;
        float own[4];
        bool some = false;
        UNROLLED for (int i = 0; i < 4; ++i) {
          own[i] = d < 4 * block ? w.pivots[i][d] : 0.0f;
          some = some || own[i] != 0.0f;
        }
        columns[slot] = ballot(some);
        b.solve(own, c[slot]);
        UNROLLED for (int i = 0; i < 4; ++i) h.gradient[slot] = h.gradient[slot] - c[slot][i] * gradient.v[i];
      }
      UNROLLED for (int pair = 0; 2 * pair < first; ++pair) {  // of quads
        if (!(columns[8 * pair / LANES] >> 8 * pair % LANES & 255)) continue;
        UNROLLED for (int i = 2 * pair; i < 2 * pair + 2 && i < first; ++i) {
          UNROLLED for (int k = 0; k < 4; ++k) rows[k] = read4(w.pivots[k] + 4 * i);
          UNROLLED for (int slot = 0; LANES * slot < 4 * first; ++slot) {
            if (4 * i >= LANES * (slot + 1)) continue;
            UNROLLED for (int k = 0; k < 4; ++k)
              UNROLLED for (int j = 0; j < 4; ++j)
                h.row[slot][4 * i + j] = h.row[slot][4 * i + j] - c[slot][k] * rows[k].v[j];
          }
        }
      }
      sync();
      if (block - 1 == last) break;
      hand_over(h, (4 * first - 1) / LANES, block - 1, first - 1);
    }
  }

  // Flags a world of whose entry of the diagonal elimination leaves little but rounding. Takes one over the pivot.
  static INLINE bool is_lost(float whole, float inverse_pivot) {
    return !((inverse_pivot > 0.0f) & (whole * inverse_pivot * Model::least_pivot() < 1.0f));
  }
  INLINE void look_at_pivots(const Slots& h) const {
    const int places[4] = {0, 2, 3, 9};  // in what Block::write writes
    bool lost = false;
    OWN_DOFS(slot, d) {
      if (d >= DOFS) continue;
      const float inverse_pivot = LANES == 1 ? divide(1.0f, h.diagonal[slot]) : w.blocks[d / 4][places[d % 4]];
      lost |= is_lost(h.whole[slot], inverse_pivot);
    }
    if (ballot(lost)) flag(UNSOLVED);
  }

  // Solves H x = -gradient for the search direction x.
  INLINE void factor_and_solve(Slots& h) {
    OWN_DOFS(slot, d) h.gradient[slot] = -h.gradient[slot];
    if (LANES == 1) {
      factor_and_solve_alone(h);
      return;
    }
    if (DOFS < STRIDE && lane < QUADS) {  // rows that fill up the first block, and go through nothing else
      UNROLLED for (int i = DOFS % 4; i < 4; ++i) {
        write4(w.pivots[i] + 4 * lane, {0.0f, 0.0f, 0.0f, 0.0f});
        w.pivot_damping[i] = 1.0f;
        w.pivot_gradient[i] = 0.0f;
      }
    }
//ELIMINATE
    sync();
    // Substitution from the first block to the last. All subtract; those who are done take no harm.
    UNROLLED for (int block = 0; block < QUADS; ++block) {
      const int first = 4 * block, own = first / LANES;
      Block b;
      b.read(w.blocks[block]);
      float y[4], x[4];
      UNROLLED for (int i = 0; i < 4; ++i) y[i] = first + i < DOFS ? read(h.gradient[own], (first + i) % LANES) : 0.0f;
      b.solve(y, x);
      if (lane == 0) write4(w.search + first, {x[0], x[1], x[2], x[3]});
      UNROLLED for (int slot = own; slot < SLOTS; ++slot)
        UNROLLED for (int i = 0; i < 4; ++i) h.gradient[slot] = h.gradient[slot] - h.row[slot][first + i] * x[i];
    }
    sync();
  }

  // The same with a single lane, which can skip what is zero: branches of the tree that do not meet.
  INLINE void factor_and_solve_alone(Slots& h) {
    for (int k = 0; k < DOFS; ++k) h.diagonal[k] += h.row[k][k];
    for (int k = DOFS - 1; k > 0; --k) {
      const float inverse = divide(1.0f, h.diagonal[k]);
      for (int i = 0; i < k; ++i) {
        if (h.row[k][i] == 0.0f) continue;
        const float c = h.row[k][i] * inverse;
        for (int j = 0; j < i; j += 4)  // by fours, for vector instructions; right of the diagonal nothing is used
          for (int l = j; l < j + 4; ++l) h.row[i][l] -= c * h.row[k][l];
        h.diagonal[i] -= c * h.row[k][i];
        h.gradient[i] -= c * h.gradient[k];
      }
    }
    for (int i = 0; i < DOFS; ++i) {
      float x = h.gradient[i];
      for (int j = 0; j < i; ++j) x -= h.row[i][j] * w.search[j];
      w.search[i] = divide(x, h.diagonal[i]);
    }
  }

//IF LIMBS
#ifdef __CUDA_ARCH__
  // The Hessian without its zeros. The trunk is what several limbs share, a limb what branches off and does not branch
  // again. While no contact couples two limbs, a row of a limb has the columns of the trunk and those of its limb, and
  // the limbs are eliminated side by side, from their ends. What they leave of the trunk is small enough for each lane
  // to solve it alone.
  enum {
    LIMB_ROWS = Model::LIMB_ROWS,  // of limbs, in one hold; the rows of the trunk follow
    HOLDS = (LIMB_ROWS + TRUNK + LANES - 1) / LANES,
    ENTRIES = (CORNER + LANES - 1) / LANES,
    KEPT = TRUNK < 6 ? TRUNK : 6,  // rows of the trunk that each lane eliminates alone
    KEPT_QUADS = (KEPT * (KEPT + 1) / 2 + 3) / 4,
  };
#define OWN_ROWS(hold, row) UNROLLED for (int hold = 0, row = lane; hold < HOLDS; ++hold, row += LANES)

  struct Branches {
    float trunk[HOLDS][TRUNK], limb[LIMB];  // the last LIMB columns up to the end of the limb
    float diagonal[HOLDS], gradient[HOLDS];
  };

  struct Factors { float of[DIRECTIONS]; };  // of rows of the Jacobian for a row of the Hessian

  static INLINE int dof_of_row(int row) { return Model::limb_row_dof(row < LIMB_ROWS + TRUNK ? row : 0); }
  static INLINE int limb_columns(int row) { return Model::limb_row_end(row < LIMB_ROWS ? row : 0) - LIMB; }

  // A number of each degree of freedom, from its owner.
  INLINE float of_dof(const float* x, int d) const {
    float value = read(x[0], d % LANES);
    UNROLLED for (int slot = 1; slot < SLOTS; ++slot) {
      const float other = read(x[slot], d % LANES);
      if (d / LANES == slot) value = other;
    }
    return value;
  }

  static INLINE void read_trunk(const float* row, float* columns) {
    UNROLLED for (int i = 0; i < QUADS; ++i) {
      bool some = false;
      UNROLLED for (int k = 4 * i; k < 4 * i + 4; ++k) some = some || Model::trunk_place(k) >= 0;
      if (!some) continue;
      const Quad q = read4(row + 4 * i);
      UNROLLED for (int k = 0; k < 4; ++k) {
        const int t = Model::trunk_place(4 * i + k);
        if (t >= 0) columns[t] = q.v[k];
      }
    }
  }

  // Adds sums over n rows of the Jacobian, each times its factor for a row of the Hessian.
  INLINE void add_products(Branches& h, const float* rows, const Factors* factors, const int n) const {
    UNROLLED for (int l = 0; l < n; ++l) {
      float columns[TRUNK];
      read_trunk(rows + STRIDE * l, columns);
      OWN_ROWS(hold, row) {
        UNROLLED for (int t = 0; t < TRUNK; ++t)
          h.trunk[hold][t] = h.trunk[hold][t] + factors[hold].of[l] * columns[t];
      }
      const float* const own = rows + STRIDE * l + limb_columns(lane);
      UNROLLED for (int j = 0; j < LIMB; ++j) h.limb[j] = h.limb[j] + factors[0].of[l] * own[j];
    }
  }

  INLINE void assemble(Branches& h, const bool with_contacts, const float* diagonal, const float* gradient) const {
    OWN_ROWS(hold, row) {
      const int d = dof_of_row(row);
      const float* const mass = w.mass + STRIDE * d;
      read_trunk(mass, h.trunk[hold]);
      if (hold == 0) UNROLLED for (int j = 0; j < LIMB; ++j) h.limb[j] = mass[limb_columns(row) + j];
      h.diagonal[hold] = mass[d] + of_dof(diagonal, d);
      h.gradient[hold] = of_dof(gradient, d);
    }
    if (!with_contacts) return;
    Factors factors[HOLDS];
    CLOSED_CONTACTS(place, left, 0, OWN_FRICTIONAL) {
      const int from = lowest_bit(left), k = number(place, from);
      const Law cost = law(k, agreed(sides(place), from));
      const float* const rows = w.jacobian + DIRECTIONS * STRIDE * k;
      OWN_ROWS(hold, row) {
        float own[DIRECTIONS];
        UNROLLED for (int i = 0; i < DIRECTIONS; ++i) own[i] = rows[STRIDE * i + dof_of_row(row)];
        cost.times(own, factors[hold].of);
        UNROLLED for (int i = 0; i < DIRECTIONS; ++i) {
          h.gradient[hold] = h.gradient[hold] + cost.gradient[i] * own[i];
          h.diagonal[hold] = h.diagonal[hold] + factors[hold].of[i] * own[i];
        }
      }
      add_products(h, rows, factors, DIRECTIONS);
    }
    CLOSED_CONTACTS(place, left, OWN_FRICTIONAL, CONTACT_SLOTS) {
      const int k = number(place, lowest_bit(left));
      const float x = w.x[first_frictionless() + k], weight = w.weight[first_frictionless() + k];
      const float* const row_of_contact = w.jacobian + STRIDE * (DIRECTIONS * frictional + k);
      OWN_ROWS(hold, row) {
        const float own = row_of_contact[dof_of_row(row)];
        factors[hold].of[0] = weight * own;
        h.gradient[hold] = h.gradient[hold] + factors[hold].of[0] * x;
        h.diagonal[hold] = h.diagonal[hold] + factors[hold].of[0] * own;
      }
      add_products(h, row_of_contact, factors, 1);
    }
  }

  // Solves H x = gradient, sets the search direction to -x, and adds x times the gradient before.
  INLINE void factor_and_solve(Branches& h, const bool damping_alone, float& decrement) const {
    const bool limb = lane < LIMB_ROWS;
    const int end = Model::limb_row_end(limb ? lane : 0), skipped = LIMB - Model::limb_length(Model::limb_of_row(limb ? lane : 0));
    const int above = limb ? end - 1 - dof_of_row(lane) : -1, place = LIMB - 1 - above;  // rows to eliminate before
    const int base = PIVOT * Model::limb_of_row(limb ? lane : 0);
    UNROLLED for (int j = 0; j < LIMB; ++j) if (j < skipped) h.limb[j] = 0.0f;
    float before[HOLDS], whole[HOLDS], left[ENTRIES];
    OWN_ROWS(hold, row) {
      before[hold] = h.gradient[hold];
      whole[hold] = h.diagonal[hold];
      const int t = row - LIMB_ROWS;
      if (t < 0 || t >= TRUNK) continue;
      float* const corner = w.corner + LOWER + t * (t + 1) / 2;
      UNROLLED for (int j = 0; j < TRUNK; ++j) if (j < t) corner[j] = h.trunk[hold][j];
      corner[t] = h.diagonal[hold];
      w.corner[t] = h.gradient[hold];
    }
    UNROLLED for (int i = 0; i < ENTRIES; ++i) left[i] = 0.0f;
    ROLLED for (int step = 0; step < LIMB; ++step) {
      float* const pivots = w.limb_pivots[step & 1];
      if (above == step) {
        const float scale = inverse_root(h.diagonal[0]);
        float row[PIVOT];
        UNROLLED for (int t = 0; t < TRUNK; ++t) row[t] = h.trunk[0][t] * scale;
        row[TRUNK] = h.gradient[0] * scale;
        UNROLLED for (int j = 0; j + TRUNK + 1 < PIVOT; ++j) row[TRUNK + 1 + j] = j < LIMB ? h.limb[j] * scale : 0.0f;
        UNROLLED for (int i = 0; i < PIVOT; i += 4) write4(pivots + base + i, {row[i], row[i + 1], row[i + 2], row[i + 3]});
      }
      sync();
      if (above > step) {
        const float c = pivots[base + TRUNK + 1 + place];
        float row[PIVOT];
        UNROLLED for (int i = 0; i < PIVOT; i += 4) {
          const Quad q = read4(pivots + base + i);
          UNROLLED for (int k = 0; k < 4; ++k) row[i + k] = q.v[k];
        }
        UNROLLED for (int t = 0; t < TRUNK; ++t) h.trunk[0][t] = h.trunk[0][t] - c * row[t];
        h.gradient[0] = h.gradient[0] - c * row[TRUNK];
        UNROLLED for (int j = 0; j < LIMB; ++j) h.limb[j] = h.limb[j] - c * row[TRUNK + 1 + j];
        h.diagonal[0] = h.diagonal[0] - c * c;
      }
      UNROLLED for (int i = 0; i < ENTRIES; ++i) {
        const int e = lane + LANES * i < CORNER ? lane + LANES * i : 0;
        const float *const a = pivots + Model::corner_row(e), *const b = pivots + Model::corner_column(e);
        UNROLLED for (int l = 0; l < Model::LIMBS; ++l)
          if (step < Model::limb_length(l)) left[i] = left[i] + a[PIVOT * l] * b[PIVOT * l];
      }
    }
    UNROLLED for (int i = 0; i < ENTRIES; ++i)
      if (lane + LANES * i < CORNER) w.corner[lane + LANES * i] -= left[i];
    sync();
    ROLLED for (int k = TRUNK - 1; k >= KEPT; --k) {  // an entry a lane
      const float* const row = w.corner + LOWER + k * (k + 1) / 2;
      const float pivot = inverse(row[k]);
      UNROLLED for (int n = 0; n < ENTRIES; ++n) {
        const int e = lane + LANES * n;
        if (e >= CORNER) continue;
        const int i = Model::corner_row(e), j = Model::corner_column(e);
        if (i < k) w.corner[e] -= row[i] * pivot * (j < TRUNK ? row[j] : w.corner[k]);
      }
      sync();
    }

    // H = L' D L of the rest of the trunk, and its solution.
    float kept[LOWER + KEPT_QUADS * 4], inverse[KEPT], x[TRUNK];
    UNROLLED for (int i = 0; i < LOWER + KEPT_QUADS * 4; i += 4) {
      const Quad q = read4(w.corner + i);
      UNROLLED for (int k = 0; k < 4; ++k) kept[i + k] = q.v[k];
    }
    float *const rest = kept, *const corner = kept + LOWER;
    UNROLLED for (int k = KEPT - 1; k >= 0; --k) {
      const float* const row = corner + k * (k + 1) / 2;
      inverse[k] = Math::inverse(row[k]);
      UNROLLED for (int i = 0; i < k; ++i) {
        const float c = row[i] * inverse[k];
        UNROLLED for (int j = 0; j <= i; ++j)
          corner[i * (i + 1) / 2 + j] = corner[i * (i + 1) / 2 + j] - c * row[j];
        rest[i] = rest[i] - c * rest[k];
      }
    }
    UNROLLED for (int k = 0; k < KEPT; ++k) {
      x[k] = rest[k];
      UNROLLED for (int j = 0; j < k; ++j) x[k] = x[k] - corner[k * (k + 1) / 2 + j] * x[j];
      x[k] = x[k] * inverse[k];
    }
    UNROLLED for (int k = KEPT; k < TRUNK; ++k) {
      const float* const row = w.corner + LOWER + k * (k + 1) / 2;
      x[k] = w.corner[k];
      UNROLLED for (int j = 0; j < k; ++j) x[k] = x[k] - row[j] * x[j];
      x[k] = divide(x[k], row[k]);
    }
    float solution[HOLDS];
    bool lost = false;
    OWN_ROWS(hold, row) {
      solution[hold] = 0.0f;
      UNROLLED for (int t = 0; t < TRUNK; ++t) {
        if (row != LIMB_ROWS + t) continue;
        solution[hold] = x[t];
        if (Model::DELICATE)
          lost |= is_lost(whole[hold], t < KEPT ? inverse[t] : Math::inverse(w.corner[LOWER + t * (t + 3) / 2]));
      }
    }
    // The limbs, outwards. All subtract; those who are done take no harm.
    float y = h.gradient[0];
    UNROLLED for (int t = 0; t < TRUNK; ++t) y = y - h.trunk[0][t] * x[t];
    const float own_inverse = Math::inverse(h.diagonal[0]);
    if (Model::DELICATE && !damping_alone && ballot(lost | (limb & is_lost(whole[0], own_inverse)))) flag(UNSOLVED);
    UNROLLED for (int j = 0; j < LIMB; ++j) {
      const float own = y * own_inverse, found = read(own, (lane - place + j) % LANES);
      if (limb && j == place) solution[0] = own;
      y = y - h.limb[j] * found;
    }
    OWN_ROWS(hold, row) {
      if (row >= LIMB_ROWS + TRUNK) continue;
      w.search[dof_of_row(row)] = -solution[hold];
      decrement = decrement + solution[hold] * before[hold];
    }
  }
#endif

//END
  // Sets the search direction, gradient' gradient and gradient' H^-1 gradient; or as the direction what implicit damping
  // adds to qacc.
  INLINE void set_direction(const bool damping_alone, const float regularisation, float& gradient_squared,
                            float& decrement) {
    float diagonal[SLOTS], gradient[SLOTS], sums[2] = {0.0f, 0.0f};
    own_terms(damping_alone, regularisation, diagonal, gradient);
    bool by_limbs = false;
//IF LIMBS
#ifdef __CUDA_ARCH__
    by_limbs = damping_alone || !crossing;
    if (by_limbs) {
      Branches h;
      assemble(h, !damping_alone, diagonal, gradient);
      OWN_ROWS(hold, row) if (row < LIMB_ROWS + TRUNK) sums[0] += h.gradient[hold] * h.gradient[hold];
      factor_and_solve(h, damping_alone, sums[1]);
    }
#endif
//END
    if (!by_limbs) {
      Slots h;
      OWN_DOFS(slot, d) {
        h.diagonal[slot] = diagonal[slot];
        h.gradient[slot] = gradient[slot];
      }
      start_from_mass(h);
      if (!damping_alone) add_contacts(h);
      OWN_DOFS(slot, d) {
        gradient[slot] = d < DOFS ? h.gradient[slot] : 0.0f;
        sums[0] += gradient[slot] * gradient[slot];
      }
      factor_and_solve(h);
      if (Model::DELICATE && !damping_alone) look_at_pivots(h);
      OWN_DOFS(slot, d) if (d < DOFS) sums[1] -= gradient[slot] * w.search[d];
    }
    if (damping_alone) return;
    sum(sums, 2);
    gradient_squared = sums[0];
    decrement = sums[1];
  }

  // A row of a matrix times a vector, in four sums that do not wait for each other.
  static INLINE float times(const float* matrix_row, const float* vector) {
    float sums[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    UNROLLED for (int i = 0; i < QUADS; ++i) {
      const Quad a = read4(matrix_row + 4 * i), s = read4(vector + 4 * i);
      UNROLLED for (int k = 0; k < 4; ++k) sums[k] = sums[k] + a.v[k] * s.v[k];
    }
    return (sums[0] + sums[1]) + (sums[2] + sums[3]);
  }

  // M and J times the search direction, a row a lane, and how the residuals change along it.
  INLINE void project() {
    sync();
    SHARED_LOOP(i, DOFS + jacobian_rows()) {  // rows of J in the rounds of those of M
      const int r = i - DOFS;
      const float product = times(r < 0 ? w.mass + STRIDE * i : w.jacobian + STRIDE * r, w.search);
      *(r < 0 ? w.mass_search + i : w.projected + r) = product;
    }
    sync();
    SHARED_LOOP(r, rows()) w.change[r] = row_velocity(r, w.search);
    sync();
  }

  // Brings velocity and acceleration into the rows, and the acceleration into the residual of M. A row that is no number,
  // which would be on no side of its constraint, makes that residual none.
  INLINE void complete_rows() {
    SHARED_LOOP(i, DOFS + jacobian_rows()) {
      const int r = i - DOFS;
      const float* const row = r < 0 ? w.mass + STRIDE * i : w.jacobian + STRIDE * r;
      const float product = times(row, w.qacc);
      if (r < 0) {
        w.residual[i] += product;
        continue;
      }
      const int c = r < DIRECTIONS * frictional ? r / DIRECTIONS : r - (DIRECTIONS - 1) * frictional;
      const float damping = Model::contact_softness(contact(c).pair()).damping;
      w.projected[r] = product + damping * times(row, w.qvel);
    }
    sync();
    SHARED_LOOP(r, rows()) {
      float v = row_velocity(r, w.qacc);
      if (r >= first_limit()) v += row_damping(r) * row_velocity(r, w.qvel);
      const float x = w.x[r] += v;
      if (!(x == x)) w.residual[0] = x;
    }
    sync();
  }

  INLINE void lose() { w.qacc[0] = from_bits(NAN_BITS); }

  // ---- Line search

  // A row that has a cost of its own.
  INLINE ConstraintRow single(int r) const {
    const bool dry = Model::FRICTION_LOSSES && r >= first_friction();
    return {w.x[r], w.change[r], w.weight[r], dry ? Model::friction_bound(r - first_friction()) : 0.0f, dry};
  }

//IF ELLIPTIC
  enum { OWN_CONES = (Model::FRICTIONAL + LANES - 1) / LANES };
  struct Lines { Cone::Line of[OWN_CONES]; };  // of the contacts lane, lane + LANES, ...
//ELSE
  struct Lines {};
//END

  // Adds what n steps change of the costs of all rows, and slopes and curvatures there, to three sums each.
  INLINE void add_rows(const Lines& lines, const float* alphas, const int n, float* sums) const {
//IF ELLIPTIC
    UNROLLED for (int own = 0; own < OWN_CONES; ++own) {
      if (lane + LANES * own >= frictional) break;
      UNROLLED for (int k = 0; k < n; ++k) lines.of[own].add(alphas[k], sums + 3 * k);
    }
//END
    SHARED_LOOP(i, rows() - first_single()) {
      const ConstraintRow row = single(first_single() + i);
      UNROLLED for (int k = 0; k < n; ++k) row.add(alphas[k], sums + 3 * k);
    }
    sum(sums, 3 * n);
  }

  INLINE Search line_search(const float decrement, const bool guessed) {
    float t[7] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
    OWN_DOFS(slot, d) {
      if (d >= DOFS) continue;
      const float s = w.search[d];
      t[0] += s * w.residual[d];
      t[1] += s * w.mass_search[d];
      t[2] += s * s;
    }
    Lines lines;
//IF ELLIPTIC
    UNROLLED for (int own = 0; own < OWN_CONES; ++own) {
      const int first = CONTACT_ROWS * (lane + LANES * own);
      if (first >= first_frictionless()) break;
      Cone::Line& line = lines.of[own];
      line.set(w.x + first, w.change + first, w.weight[first], w.weight[first + 1]);
      t[3] += line.cost();
      line.add(1.0f, t + 4);
    }
//END
    SHARED_LOOP(i, rows() - first_single()) {
      const ConstraintRow row = single(first_single() + i);
      t[3] += row.cost();
      row.add(1.0f, t + 4);
    }
    sum(t, 7);
    const float *const quadratic = t, *const whole = t + 3;
    const auto add_rows = [&](const float* alphas, const int n, float* sums) { this->add_rows(lines, alphas, n, sums); };
//LINE_SEARCH
  }

  // Moves along the direction, if at all, and returns whether a row is not where it was taken to be.
  INLINE bool move(const Search& step) {
    const float alpha = step.alpha;
    OWN_DOFS(slot, d) {
      if (d >= DOFS || alpha == 0.0f) continue;
      w.qacc[d] += alpha * w.search[d];
      w.residual[d] += alpha * w.mass_search[d];
    }
    bool crossed = false;
    SHARED_LOOP(r, alpha == 0.0f ? 0 : rows()) {
      const float before = w.x[r], next = before + alpha * w.change[r];
      if (Model::FRICTION_LOSSES && r >= first_friction())
        crossed |= DryFriction::crosses(before, next, Model::friction_bound(r - first_friction()));
      w.x[r] = next;
    }
    sync();
    crossed |= find_sides();
    return ballot(crossed) != 0;
  }

  // Leaves the acceleration in qacc; with implicit damping, search is what has to be added to it before integration.
  INLINE void solve(const bool live) {
    bool guesses = false;
    if (live) {
      complete_rows();
      guesses = guess_sides() && GUESSES;
    }
//NEWTON
    sync();
  }

  // ---- Integration: semi-implicit Euler

  INLINE void integrate() {
    const float h = Model::timestep();
    OWN_DOFS(slot, d) {
      if (d >= DOFS) continue;
      const float v = w.qvel[d] + h * (Model::IMPLICIT_DAMPING ? w.qacc[d] + w.search[d] : w.qacc[d]);
      w.qvel[d] = v;
      if (Model::dof_kind(d) != ROTATION) w.qpos[Model::dof_qpos(d)] += h * v;
    }
    sync();
    SHARED_LOOP(i, Model::QUATERNIONS) {
      const int q = Model::quaternion_qpos(i), d = Model::quaternion_dof(i);
      const Vec rate = {w.qvel[d], w.qvel[d + 1], w.qvel[d + 2]};
      const Quat next = Quat{w.qpos[q], w.qpos[q + 1], w.qpos[q + 2], w.qpos[q + 3]}.turned(rate, h);
      w.qpos[q] = next.w;
      w.qpos[q + 1] = next.x;
      w.qpos[q + 2] = next.y;
      w.qpos[q + 3] = next.z;
    }
    sync();
  }

  // ---- Touch sensors

  // A touch sensor feels a contact of its body if the ray from the point along the normal, into the body, meets its
  // site.
  INLINE void feel_contacts() {
    SHARED_LOOP(i, frictional + frictionless) {
      const Contact c = contact(i);
      unsigned felt = 0;
      ROLLED for (int s = 0; s < Model::TOUCH && c.pair() < Model::PAIRS; ++s) {
        const int body = Model::site_body(s);
        const bool first = body == Model::first_body(c.pair()), second = body == Model::second_body(c.pair());
        const Pose pose = pose_of(Model::site_link(s));
        const Mat site = Model::site_orientation(s);
        const Vec p = c.point + w.com[0] - pose.position;
        const Vec offset = pose.orientation.transposed_times(p) - Model::site_position(s);
        const Vec ray = pose.orientation.transposed_times(c.normal) * (second ? -1.0f : 1.0f);
        const Vec start = site.transposed_times(offset), along = site.transposed_times(ray);
        const bool meets = Interval::meets(Model::site_shape(s), Model::site_size(s), start, along);
        if ((first || second) && meets) felt |= 1u << s;
      }
      w.zones[place_of(i)] = felt;
    }
  }

  // The sum of the normal forces of the contacts that each sensor feels.
  INLINE void write_touch(float* sensordata) const {
    ROLLED for (int s = 0; s < Model::TOUCH; ++s) {
      float force = 0.0f;
//IF ELLIPTIC
      SHARED_LOOP(k, frictional)
        if (w.zones[k] >> s & 1) force -= law(k).gradient[0];
//END
      SHARED_LOOP(i, first_limit() - first_single()) {
        const int r = first_single() + i;
        const bool felt = w.zones[place_of(contact_of_row(r))] >> s & 1;
        if (felt) force -= OneSided::gradient(w.x[r], w.weight[r]);
      }
      sum(&force, 1);
      if (lane == 0) sensordata[Model::touch_address(s)] = force;
    }
  }

//IF CONTACT_GEOMS
  // ---- Contact forces of geoms

  INLINE void keep_contacts() {
    UNROLLED for (int own = 0; own < OWN_CONTACTS; ++own) {
      const int i = lane + LANES * own;
      if (i >= frictional + frictionless) continue;
      const Contact c = contact(i);
      own_contacts[own] = {c.normal, c.normal, c.pair()};
      if (i < frictional) own_contacts[own].tangent = w.tangents[i] * Model::friction(c.pair());
    }
    sync();
  }

  // The force of an own contact on its second geom.
  INLINE Vec contact_force(int i, const OwnContact& c) const {
    if (i >= frictional) {
      const int r = first_frictionless() + i - frictional;
      return c.normal * -OneSided::gradient(w.x[r], w.weight[r]);
    }
    const Law cost = law(i);
    return c.normal * -cost.gradient[0] + c.tangent * -cost.gradient[1] +
           second_tangent(c.normal, c.tangent, c.pair) * -cost.gradient[2];
  }

  // The sum of the contact forces on each geom, and whether there is a contact. A lane adds up those of its geoms.
  INLINE void write_contact_forces(float* forces, bool* touches) const {
    enum { OWN_GEOMS = (Model::CONTACT_GEOMS + LANES - 1) / LANES };
    Vec total[OWN_GEOMS];
    bool touched[OWN_GEOMS];
    UNROLLED for (int own = 0; own < OWN_GEOMS; ++own) {
      total[own] = {0.0f, 0.0f, 0.0f};
      touched[own] = false;
    }
    UNROLLED for (int own = 0; own < OWN_CONTACTS; ++own) {
      const int left = frictional + frictionless - LANES * own, i = lane + LANES * own;
      if (left <= 0) break;
      Vec push = {0.0f, 0.0f, 0.0f};
      int first = -1, second = -1;
      if (lane < left) {
        const OwnContact c = own_contacts[own];
        push = contact_force(i, c);
        first = Model::first_contact_geom(c.pair);
        second = Model::second_contact_geom(c.pair);
      }
      const int end = left < LANES ? left : LANES;
      ROLLED for (int from = 0; from < end; ++from) {
        const Vec force = {read(push.x, from), read(push.y, from), read(push.z, from)};
        const int minus = read(first, from), plus = read(second, from);
        UNROLLED for (int own_geom = 0; own_geom < OWN_GEOMS; ++own_geom) {
          const int g = lane + LANES * own_geom;
          if (minus != g && plus != g) continue;
          total[own_geom] = total[own_geom] + force * (plus == g ? 1.0f : -1.0f);
          touched[own_geom] = true;
        }
      }
    }
    UNROLLED for (int own = 0; own < OWN_GEOMS; ++own) {
      const int g = lane + LANES * own;
      if (g >= Model::CONTACT_GEOMS) break;
      UNROLLED for (int k = 0; k < 3; ++k) forces[3 * g + k] = total[own].component(k);
      touches[g] = touched[own];
    }
  }

//END
  // ---- The whole

  INLINE void kinematics() {
    poses();
    velocities();
  }

  INLINE void dynamics() {
    subtrees();
    mass_matrix();
    find_contacts();
    jacobians();
    set_rows();
  }

  // Poses of all bodies, and their velocities unless nobody asked for them.
  INLINE void write_bodies(float* xpos, float* xmat, float* cvel) const {
    SHARED_LOOP(b, Model::BODIES) {
      const int link = Model::body_link(b);
      const Pose pose = pose_of(link);
      const Vec position = pose.position + pose.orientation * Model::body_position(b);
      const Mat orientation = Model::body_orientation(b);
      const Motion velocity = link < 0 ? Motion{{0.0f, 0.0f, 0.0f}, {0.0f, 0.0f, 0.0f}} : w.velocity[link];
      xpos[3 * b] = position.x;
      xpos[3 * b + 1] = position.y;
      xpos[3 * b + 2] = position.z;
      UNROLLED for (int i = 0; i < 3; ++i) {
        const Vec column = pose.orientation * orientation.column(i);
        xmat[9 * b + i] = column.x;
        xmat[9 * b + 3 + i] = column.y;
        xmat[9 * b + 6 + i] = column.z;
        if (!cvel) continue;
        cvel[6 * b + i] = velocity.angular.component(i);
        cvel[6 * b + 3 + i] = velocity.linear.component(i);
      }
    }
  }

//IF SUBTREE_COM
  // Centres of mass of the trees, in the rows of their roots.
  INLINE void write_centers(float* subtree_com) const {
    SHARED_LOOP(t, Model::TREES)
      UNROLLED for (int k = 0; k < 3; ++k) subtree_com[3 * Model::root_body(t) + k] = w.com[t].component(k);
  }

//END
  // Momentum of a subtree over its mass.
  INLINE void write_subtree_velocities(float* sensordata) const {
    ROLLED for (int s = 0; s < Model::SUBTREES; ++s) {
      float total[3] = {0.0f, 0.0f, 0.0f};
      const int end = Model::first_part(s + 1);
      ROLLED for (int i = Model::first_part(s) + lane; i < end; i += LANES) {
        const int link = Model::part_link(i);
        const Pose pose = w.pose[link];
        const Vec offset = pose.position + pose.orientation * Model::part_center(i) - w.com[Model::tree(link)];
        const Motion velocity = w.velocity[link];
        const Vec v = velocity.linear + velocity.angular.cross(offset);
        UNROLLED for (int k = 0; k < 3; ++k) total[k] += Model::part_share(i) * v.component(k);
      }
      sum(total, 3);
      SHARED_LOOP(k, 3) sensordata[Model::subtree_address(s) + k] = k == 0 ? total[0] : k == 1 ? total[1] : total[2];
    }
  }

//IF MOMENTA
  // Angular momentum of a subtree about its centre of mass: that about the centre of its tree, less what its linear
  // momentum at its own centre has about that.
  INLINE void write_angular_momenta(float* sensordata) const {
    ROLLED for (int s = 0; s < Model::MOMENTA; ++s) {
      Vec momentum = {0.0f, 0.0f, 0.0f}, linear = momentum, center = momentum;
      const int end = Model::first_momentum_part(s + 1);
      ROLLED for (int i = Model::first_momentum_part(s) + lane; i < end; i += LANES) {
        const int link = Model::momentum_link(i);
        const Pose pose = w.pose[link];
        const Vec offset = pose.position + pose.orientation * Model::momentum_center(i) - w.com[Model::tree(link)];
        const Motion velocity = w.velocity[link];
        const float mass = Model::momentum_mass(i);
        const Vec push = (velocity.linear + velocity.angular.cross(offset)) * mass;
        const Symmetric inertia = Model::momentum_inertia(i).turned(pose.orientation);
        momentum = momentum + inertia * velocity.angular + offset.cross(push);
        linear = linear + push;
        center = center + offset * mass;
      }
      float total[9] = {momentum.x, momentum.y, momentum.z, linear.x, linear.y, linear.z, center.x, center.y, center.z};
      sum(total, 9);
      const Vec about = Vec{total[6], total[7], total[8]} * Model::momentum_inverse_mass(s);
      const Vec found = Vec{total[0], total[1], total[2]} - about.cross({total[3], total[4], total[5]});
      SHARED_LOOP(k, 3) sensordata[Model::momentum_address(s) + k] = found.component(k);
    }
  }
//END
};

// ---- The control step ----------------------------------------------------------------------------------------------

static_assert(sizeof(World) == Model::WORLD_BYTES, "lanes.py counts on this size");
#ifdef __CUDA_ARCH__
static __shared__ World worlds[Model::WORLDS_PER_BLOCK];
World& w = worlds[threadIdx.x / LANES];
// Warps that run in step share what they fetch of the text. Lanes without a world keep to the step but do nothing else.
#define LOCKSTEP() if (Model::LOCKSTEP) __syncthreads()
#else
World storage;
World& w = storage;
#define LOCKSTEP()
#endif
const unsigned this_world = live ? world : 0;
const auto row_of = [=](auto* data, unsigned size) {  // products of 32 bits could wrap
  return data + static_cast<size_t>(this_world) * size;
};
float* const sensors = row_of(sensordata_out.data, Model::SENSOR_VALUES);
float* const row = row_of(numbers_out.data, numbers_out.shape[1]);
Step step(w, lane, row_of(ctrl_in.data, Model::CONTROLS), overflow_out.data[this_world], row);
if (live && lane == 0) {  // in a step that is not taken, numbers may have changed
//DERIVE
}
if (live) {
  step.sync();  // the first lane may have written the state
  SHARED_LOOP(i, Model::POSITIONS) w.qpos[i] = row_of(qpos_out.data, Model::POSITIONS)[i];
  SHARED_LOOP(i, STRIDE) {
    w.qvel[i] = i < DOFS ? row_of(qvel_out.data, DOFS)[i] : 0.0f;
    w.qacc[i] = i < DOFS ? row_of(qacc_warmstart_out.data, DOFS)[i] : 0.0f;
    w.search[i] = 0.0f;
  }
  SHARED_LOOP(i, DOFS * STRIDE) w.mass[i] = 0.0f;
  step.sync();
}
//IF CONTACT_GEOMS
const int contacts = Model::HISTORY * Model::CONTACT_GEOMS;
float* const contact_forces = reinterpret_cast<float*>(row_of(contact_force_out.data, contacts));
bool* const in_contact = row_of(in_contact_out.data, contacts);
//END
if (live && Model::SUBSTEPS == 0 && Model::TOUCH + Model::CONTACT_GEOMS > 0) {  // a step that is not taken finds forces
  step.kinematics();
  step.dynamics();
//IF CONTACT_GEOMS
  step.keep_contacts();
//END
  step.solve(true);
  step.write_touch(sensors);
//IF CONTACT_GEOMS
  ROLLED for (int row = 0; row < Model::HISTORY; ++row)
    step.write_contact_forces(contact_forces + 3 * Model::CONTACT_GEOMS * row, in_contact + Model::CONTACT_GEOMS * row);
//END
}
ROLLED for (int substep = 0;; ++substep) {
  LOCKSTEP();
  if (live) step.kinematics();
  if (substep == Model::SUBSTEPS) break;
  if (live) {
    step.dynamics();
//IF CONTACT_GEOMS
    if (substep >= Model::SUBSTEPS - Model::HISTORY) step.keep_contacts();
//END
  }
  step.solve(live);
  if (live) {
    if (Model::TOUCH && substep == Model::SUBSTEPS - 1) step.write_touch(sensors);
//IF CONTACT_GEOMS
    const int first = Model::CONTACT_GEOMS * (substep - (Model::SUBSTEPS - Model::HISTORY));
    if (first >= 0) step.write_contact_forces(contact_forces + 3 * first, in_contact + first);
//END
    step.integrate();
  }
}
if (live) {
  step.write_bodies(reinterpret_cast<float*>(row_of(xpos_out.data, Model::BODIES)),
                    reinterpret_cast<float*>(row_of(xmat_out.data, Model::BODIES)),
                    cvel_out.data ? reinterpret_cast<float*>(row_of(cvel_out.data, Model::BODIES)) : nullptr);
//IF SUBTREE_COM
  step.write_centers(reinterpret_cast<float*>(row_of(subtree_com_out.data, Model::BODIES)));
//END
  step.write_subtree_velocities(sensors);
//IF MOMENTA
  step.write_angular_momenta(sensors);
//END
  if (Model::SUBSTEPS > 0) {
    SHARED_LOOP(i, Model::POSITIONS) row_of(qpos_out.data, Model::POSITIONS)[i] = w.qpos[i];
    SHARED_LOOP(i, DOFS) {
      row_of(qvel_out.data, DOFS)[i] = w.qvel[i];
      row_of(qacc_warmstart_out.data, DOFS)[i] = w.qacc[i];
    }
    if (lane == 0) time_out.data[this_world] += Model::SUBSTEPS * Model::timestep();
  }
  step.sync();  // the first lane may read it
}
#undef INLINE
#undef ROLLED
#undef UNROLLED
#undef OWN_DOFS
#undef OWN_LINKS
#undef OWN_PLACES
#undef CLOSED_CONTACTS
#undef SHARED_LOOP
#undef OWN_ROWS
#undef LOCKSTEP
