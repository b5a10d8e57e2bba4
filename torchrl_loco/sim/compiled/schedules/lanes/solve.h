// What Newton's method (newton.h) calls.

// Sets the search direction, gradient' gradient and gradient' H^-1 gradient; or as the direction what implicit damping
// adds to qacc.
INLINE void set_direction(const bool damping_alone, const float regularisation, float& gradient_squared,
                          float& decrement) {
  float diagonal[SLOTS], gradient[SLOTS], sums[2] = {0.0f, 0.0f};
  own_terms(damping_alone, regularisation, diagonal, gradient);
  bool by_limbs = false;
#if WITH_LIMBS && defined(__CUDA_ARCH__)
  by_limbs = damping_alone || !crossing;
  if (by_limbs) {
    Branches h;
    assemble(h, !damping_alone, diagonal, gradient);
    OWN_ROWS(hold, row)
      if (row < LIMB_ROWS + TRUNK) sums[0] += h.gradient[hold] * h.gradient[hold];
    solve_by_limbs(h, damping_alone, sums[1]);
  }
#endif
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
    OWN_DOFS(slot, d)
      if (d < DOFS) sums[1] -= gradient[slot] * w.search[d];
  }
  if (damping_alone) return;
  sum(sums, 2);
  gradient_squared = sums[0];
  decrement = sums[1];
}

// A row of a matrix times a vector, in four sums that do not wait for each other.
static INLINE float times(const float* matrix_row, const float* vector) {
  float sums[4] = {0.0f, 0.0f, 0.0f, 0.0f};
  UNROLLED_FOR(int i = 0; i < QUADS; ++i) {
    const Quad a = read4(matrix_row + 4 * i), s = read4(vector + 4 * i);
    UNROLLED_FOR(int k = 0; k < 4; ++k) sums[k] = sums[k] + a.v[k] * s.v[k];
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
  if (Model::TWO_SIDED && r >= first_frictionless() && is_equality(r - first_frictionless()))
    return {w.x[r], w.change[r], w.weight[r], 1e30f, true};  // on both sides, without a bound
  return {w.x[r], w.change[r], w.weight[r], dry ? Model::friction_bound(r - first_friction()) : 0.0f, dry};
}

struct Cones {  // the contacts lane, lane + LANES, ... along the direction
  Cone::Line of[Model::ELLIPTIC ? OWN_FRICTIONAL : 1];
};

// Adds what n steps change of the costs of all rows, and slopes and curvatures there, to three sums each.
INLINE void add_rows(const Cones& cones, const float* alphas, const int n, float* sums) const {
  UNROLLED_FOR(int own = 0; Model::ELLIPTIC && own < OWN_FRICTIONAL; ++own) {
    if (lane + LANES * own >= frictional) break;
    UNROLLED_FOR(int k = 0; k < n; ++k) cones.of[own].add(alphas[k], sums + 3 * k);
  }
  SHARED_LOOP(i, rows() - first_single()) {
    const ConstraintRow row = single(first_single() + i);
    UNROLLED_FOR(int k = 0; k < n; ++k) row.add(alphas[k], sums + 3 * k);
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
  Cones cones;
  UNROLLED_FOR(int own = 0; Model::ELLIPTIC && own < OWN_FRICTIONAL; ++own) {
    const int first = CONTACT_ROWS * (lane + LANES * own);
    if (first >= first_frictionless()) break;
    Cone::Line& line = cones.of[own];
    line.set(w.x + first, w.change + first, w.weight[first], w.weight[first + 1]);
    t[3] += line.cost();
    line.add(1.0f, t + 4);
  }
  SHARED_LOOP(i, rows() - first_single()) {
    const ConstraintRow row = single(first_single() + i);
    t[3] += row.cost();
    row.add(1.0f, t + 4);
  }
  sum(t, 7);
  const float *const quadratic = t, *const whole = t + 3;
  const auto add_rows = [&](const float* alphas, const int n, float* sums) { this->add_rows(cones, alphas, n, sums); };
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

// All that a solve needs.
INLINE void dynamics() {
  subtrees();
  mass_matrix();
  find_contacts();
  jacobians();
  set_rows();
}

// Semi-implicit Euler.
INLINE void integrate() {
  const float h = Model::timestep();
  if (Model::ACTIVATIONS > 0) activate();
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
    Quat{w.qpos[q], w.qpos[q + 1], w.qpos[q + 2], w.qpos[q + 3]}.turned(rate, h).write(w.qpos + q);
  }
  sync();
}
