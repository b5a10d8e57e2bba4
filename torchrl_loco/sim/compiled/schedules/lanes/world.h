// One control step of one world, taken by a group of lanes: a warp of a GPU with the world's state in shared memory, or
// one lane of a CPU. All of it is the body of a single function, so that Warp can carry it; what depends on the model
// (struct Model: sizes, constants and tables) is written into it by members.py.
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
  INLINE Vec at(Vec point) const { return linear + angular.cross(point); }  // how a point of the body moves
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
  ACT = (Model::POSITIONS + 3) / 4 * 4,  // where activations are, behind the positions
  // A lane looks after the contacts lane, lane + LANES, ... with friction, then after those without.
  OWN_FRICTIONAL = (Model::FRICTIONAL + LANES - 1) / LANES,
  GUESSES = Model::SUBSTEPS > 1 && Model::ITERATIONS > 2,  // a guess that is refused has cost one of them
  CONTACT_SLOTS = OWN_FRICTIONAL + (Model::FRICTIONLESS + LANES - 1) / LANES,
  // Of a contact: which edges of its pyramid are closed, the state of its cone, or whether it is closed.
  SIDE_BITS = 10,
  NO_CONTACT = (1u << (32 - SIDE_BITS)) - 1,  // an id that none has
  // Columns are left out where a lane knows those of a contact of each kind; alone, it looks at each number itself.
  SKIPS_QUADS = SEVERAL_ROWS && LANES > 1 && (Model::FRICTIONAL <= LANES) && (Model::FRICTIONLESS <= LANES),
  DIRECTIONS = Model::DIRECTIONS,      // in which a contact with friction acts, each with a row of the Jacobian
  CONTACT_ROWS = Model::CONTACT_ROWS,  // the constraint rows of such a contact
#if WITH_LIMBS
  TRUNK = Model::TRUNK,  // degrees of freedom that several limbs share, and those of the longest limb
  LIMB = Model::LIMB,
  PIVOT = (TRUNK + LIMB + 4) / 4 * 4,  // a row of a limb: columns of the trunk, the gradient, columns of the limb
  LOWER = (TRUNK + 3) / 4 * 4,
  CORNER = (LOWER + TRUNK * (TRUNK + 1) / 2 + 3) / 4 * 4,  // of the trunk: the gradient, then the lower triangle
#endif
};
#define OWN_DOFS(slot, dof) UNROLLED_FOR(int slot = 0, dof = lane; slot < SLOTS; ++slot, dof += LANES)
#define OWN_LINKS(slot, link) UNROLLED_FOR(int slot = 0, link = lane; slot < LINK_SLOTS; ++slot, link += LANES)
// Own contacts; rolled on a CPU, where they are all of them.
#ifdef __CUDA_ARCH__
#define OWN_PLACES(own, begin, end) UNROLLED_FOR(int own = begin; own < (end); ++own)
#else
#define OWN_PLACES(own, begin, end) ROLLED_FOR(int own = begin; own < (end); ++own)
#endif
// Contacts that are taken to be closed: `left` has a bit for each of the lanes whose own ones have not been visited.
#define CLOSED_CONTACTS(own, left, begin, end) \
  OWN_PLACES(own, begin, end)                  \
    ROLLED_FOR(unsigned left = ballot(sides(own)); left; left &= left - 1)
#define SHARED_LOOP(i, count) ROLLED_FOR(int i = lane; i < (count); i += LANES)

struct alignas(16) Quad {
  float v[4];
};

struct LocalPose {
  Quat orientation;
  Vec position;
  INLINE LocalPose after(const LocalPose& parent) const {
    return {parent.orientation * orientation, parent.position + parent.orientation.rotate(position)};
  }
};
struct alignas(16) Pose {
  Mat orientation;
  Vec position;
};
struct alignas(16) Body {
  Inertia inertia;
  Vec torque, force;
};  // 16 floats
struct alignas(16) Geom {
  Vec center, half_axis;
  float radius;
};  // only a capsule has a half axis
struct alignas(16) Contact {
  Vec point;
  float distance;
  Vec normal;
  int id;  // the pair, and in the lowest bits which of its contacts it is; or beyond the pairs, a row that lasts, whose numbers these are then
  INLINE int pair() const { return id >> Model::POINT_BITS; }
};

struct alignas(16) World {
  float qpos[ACT + (Model::ACTIVATIONS + 3) / 4 * 4 + (Model::WELD_ROWS + 3) / 4 * 4];  // C++ has no empty arrays
  INLINE float* act() { return qpos + ACT; }
  INLINE float* weld_bias() { return act() + (Model::ACTIVATIONS + 3) / 4 * 4; }
  float qvel[STRIDE], qacc[STRIDE], search[STRIDE];
  float residual[STRIDE];  // M qacc minus the smooth forces
  float mass[DOFS * STRIDE];
  union {
    // Until the Jacobian is set up: of the tree for a unit velocity of each degree of freedom (cdof).
    Motion axes[DOFS];
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
#if WITH_LIMBS
    struct {
      float limb_pivots[2][Model::LIMBS * PIVOT], corner[CORNER];
    };
#endif
    float change[Model::ROWS];      // of the residuals, along the direction
    Motion velocity[Model::LINKS];  // of each link
  };
  float projected[Model::JACOBIAN_ROWS];  // Jacobian times the search direction
  union {
    struct {                  // until the contacts are known
      Motion momentum[DOFS];  // of the subtree that a degree of freedom moves, at unit velocity
      Pose pose[Model::LINKS];
      Body bodies[Model::LINKS];
      Geom geoms[Model::GEOMS + 1];
#if WITH_GROUND
      unsigned near_ground[Model::NEAR_GROUND];
      unsigned short near_pairs[Model::NEAR_PAIRS];
#endif
      unsigned short candidates[Model::CANDIDATES];
    };
    float jacobian[Model::JACOBIAN_ROWS * STRIDE];
  };
  Vec com[Model::TREES];
  unsigned char limits[Model::LIMITS + 1];  // the degree of freedom of each row of a limit, plus 128 for the upper one
  unsigned zones[Model::TOUCH ? CONTACTS : 1];  // the touch sensors that feel each contact, one bit each
};
