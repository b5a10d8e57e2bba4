// Constraint rows.

int limits;                                // violated limits of hinges and slides
int limit_row[Model::LIMIT_SIDES][SLOTS];  // the row of the limit of each own degree of freedom, or -1
// Of this lane's contacts, with friction and without, the quads of columns in which the Jacobian has numbers.
unsigned frictional_quads, frictionless_quads;
bool crossing;  // whether a contact couples two limbs

// Jacobian rows and constraint rows, in their order. A contact with friction has a Jacobian row for each direction
// (all but the normal times a factor), and a constraint row for each edge of its pyramid, or each direction of its
// cone. Limits of hinges and slides, and dry friction in joints, need no Jacobian: they act along one degree of
// freedom.
INLINE int jacobian_rows() const { return DIRECTIONS * frictional + frictionless; }
INLINE int first_frictionless() const { return CONTACT_ROWS * frictional; }
INLINE int first_limit() const { return CONTACT_ROWS * frictional + frictionless; }
INLINE int first_friction() const { return first_limit() + limits; }
INLINE int rows() const { return first_friction() + Model::FRICTION_LOSSES; }
// Those of equalities, which come first of what has no friction, hold on both sides.
INLINE bool is_equality(int row_without_friction) const { return row_without_friction < Model::TWO_SIDED; }
// Rows from here on have a cost each; those of a cone have one together.
INLINE int first_single() const { return Model::ELLIPTIC ? first_frictionless() : 0; }

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
  crossing = false;
  ROLLED_FOR(int i = 0; i < frictional + frictionless; ++i) {
    const Contact c = contact(i);
    const bool friction = i < frictional, touches = c.pair() < Model::PAIRS;
    const int pair = touches ? c.pair() : 0;
    crossing = crossing || (touches && Model::crosses(pair));
    const Model::Dofs against = Model::first_dofs(pair), with = Model::second_dofs(pair);
    Vec tangent = {0.0f, 0.0f, 0.0f}, other = tangent;
    if (friction) {
      tangent = w.tangents[i] * (own ? read(own_friction, i) : Model::friction(pair));
      other = second_tangent(c.normal, tangent, pair);
    }
    const Vec twist = c.normal * Model::torsional(pair);  // unless no contact resists turning
    const Vec roll = w.tangents[friction ? i : 0] * Model::rolling(pair);
    const Vec other_roll = c.normal.cross(roll) * Model::rolling_ratio(pair);
    float* const row = w.jacobian + STRIDE * (friction ? DIRECTIONS * i : (DIRECTIONS - 1) * frictional + i);
    OWN_DOFS(slot, d) {
      if (d >= STRIDE) continue;
      Vec point = c.point;
      if (Model::TREES > 1) point = point + w.com[0] - w.com[Model::tree(Model::dof_link(d < DOFS ? d : 0))];
      Vec velocity = axes[slot].at(point);
      const float sign = d < DOFS ? (float)((int)(with >> d & 1) - (int)(against >> d & 1)) : 0.0f;
      velocity = velocity * sign;
      if (Model::WELD_ROWS > 0 && c.pair() >= Model::FIRST_WELD) {
        const int row_of_weld = c.pair() - Model::FIRST_WELD, axis = Model::weld_axis(row_of_weld);
        const int weld = Model::weld_of_row(row_of_weld);
        const float plus = Model::weld_first_dofs(weld) >> d & 1 ? 1.0f : 0.0f;
        const float minus = Model::weld_second_dofs(weld) >> d & 1 ? 1.0f : 0.0f;
        const Vec shift = Model::TREES > 1 ? point - c.point : Vec{0.0f, 0.0f, 0.0f};
        const Vec pushed = axes[slot].at(point) * plus - axes[slot].at(c.normal + shift) * minus;
        row[d] = axis < 3 ? pushed.component(axis) : axes[slot].angular.dot(c.normal) * (plus - minus);
        continue;
      }
      if (Model::EQUALITIES && c.pair() >= Model::PAIRS + Model::BALL_LIMITS) {
        const int equality = c.pair() - (Model::PAIRS + Model::BALL_LIMITS), end = Model::first_share(equality + 1);
        float total = 0.0f;
        ROLLED_FOR(int k = Model::first_share(equality); k < end; ++k) {
          const float share = Model::share(k) * (Model::of_second(k) ? -c.normal.x : 1.0f);
          if (Model::share_dof(k) == d) total = total + share;
        }
        row[d] = total;
        continue;
      }
      if (Model::BALL_LIMITS && !touches) {
        const int k = d - Model::ball_dof(c.pair() - Model::PAIRS);
        row[d] = k >= 0 && k < 3 ? c.normal.component(k) : 0.0f;
        continue;
      }
      row[d] = velocity.dot(c.normal);
      if (friction) {
        row[STRIDE + d] = velocity.dot(tangent);
        row[2 * STRIDE + d] = velocity.dot(other);
        if (DIRECTIONS == 3) continue;
        const Vec angular = axes[slot].angular * sign;
        row[3 * STRIDE + d] = angular.dot(twist);
        if (DIRECTIONS == 4) continue;
        row[4 * STRIDE + d] = angular.dot(roll);
        row[5 * STRIDE + d] = angular.dot(other_roll);
      }
    }
  }
}

INLINE int contact_of_row(int r) const {
  return r < first_frictionless() ? r / CONTACT_ROWS : r - (CONTACT_ROWS - 1) * frictional;
}

// Velocity and acceleration follow.
INLINE void set_rows() {
  SHARED_LOOP(r, first_limit()) {
    const Contact& c = contact(contact_of_row(r));
    if (Model::ELLIPTIC && r < first_frictionless() && r % CONTACT_ROWS > 0) {  // nothing is violated off the normal
      w.weight[r] = Model::mu(c.pair());
      w.x[r] = 0.0f;
      continue;
    }
    if (r < first_frictionless() && r % CONTACT_ROWS >= Model::edges(c.pair())) {  // so far open that it stays so
      w.weight[r] = 0.0f;
      w.x[r] = 1e15f;
      continue;
    }
    float distance = c.distance;
    if (Model::WELD_ROWS > 0 && c.pair() >= Model::FIRST_WELD) {  // the impedance is that of all of its rows together
      const int i = c.pair() - Model::FIRST_WELD, axis = Model::weld_axis(i);
      const int first = contact_of_row(r) - axis, count = Model::weld_rows(Model::weld_of_row(i));
      float squared = 0.0f;
      ROLLED_FOR(int k = 0; k < count; ++k) squared += contact(first + k).distance * contact(first + k).distance;
      distance = root(squared);
    }
    Model::contact_softness(c.pair()).row(Model::inverse_inertia(c.pair()), distance,
                                          Model::least_regularisation(c.pair()), w.weight[r], w.x[r]);
    if (Model::WELD_ROWS > 0 && c.pair() >= Model::FIRST_WELD) {
      const float share = distance > 0.0f ? divide(c.distance, distance) : 0.0f;
      w.x[r] = w.x[r] * share + w.weld_bias()[c.pair() - Model::FIRST_WELD];
    }
  }
  limits = 0;
  OWN_DOFS(slot, d)
    UNROLLED_FOR(int side = 0; side < Model::LIMIT_SIDES; ++side) {
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
        Model::limit_softness(d).row(Model::limit_inverse_inertia(d), position, MINVAL, w.weight[r], w.x[r]);
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
  return Model::ELLIPTIC ? (unsigned)Cone::state(x, w.weight[CONTACT_ROWS * contact + 1]) : Pyramid::sides(x);
}
INLINE Law law(int contact, unsigned sides) const {
  const float *const x = w.x + CONTACT_ROWS * contact, *const weight = w.weight + CONTACT_ROWS * contact;
  float rows[CONTACT_ROWS];
  UNROLLED_FOR(int i = 0; i < CONTACT_ROWS; ++i) rows[i] = CONTACT_ROWS == 4 ? read4(x).v[i & 3] : x[i];
  return Law(rows, weight[0], weight[1], sides);
}
INLINE Law law(int contact) const { return law(contact, sides_of(contact)); }
