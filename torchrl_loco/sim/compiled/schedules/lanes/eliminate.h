// The Hessian by rows that the lanes own, and its elimination in blocks of four.

struct Slots {  // of the Hessian (or of M + h D): the rows that this lane owns
  float row[SLOTS][STRIDE];
  float diagonal[SLOTS], gradient[SLOTS];  // what has yet to be added to the diagonal; the right-hand side
  float whole[SLOTS];                      // the diagonal, if DELICATE
};

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
    UNROLLED_FOR(int side = 0; side < Model::LIMIT_SIDES; ++side) {
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
    UNROLLED_FOR(int i = 0; i < QUADS; ++i) {
      if (4 * i >= LANES * (slot + 1)) break;
      const Quad m = read4(w.mass + STRIDE * e + 4 * i);
      UNROLLED_FOR(int k = 0; k < 4; ++k) h.row[slot][4 * i + k] = m.v[k];
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
      UNROLLED_FOR(int i = 0; i < DIRECTIONS; ++i) own[i] = rows[STRIDE * i + e];
      cost.times(own, c);
      bool some = false;
      UNROLLED_FOR(int i = 0; i < DIRECTIONS; ++i) {
        h.gradient[slot] = h.gradient[slot] + cost.gradient[i] * own[i];
        if (Model::DELICATE) h.whole[slot] = h.whole[slot] + c[i] * own[i];
        some = some || c[i] != 0.0f;
      }
      if (LANES == 1 && !some) continue;
      UNROLLED_FOR(int i = 0; i < QUADS; ++i) {
        if (4 * i >= LANES * (slot + 1)) break;
        if (SKIPS_QUADS && !(quads >> i & 1)) continue;
        Quad columns[DIRECTIONS];
        UNROLLED_FOR(int l = 0; l < DIRECTIONS; ++l) columns[l] = read4(rows + STRIDE * l + 4 * i);
        UNROLLED_FOR(int j = 0; j < 4; ++j)
          UNROLLED_FOR(int l = 0; l < DIRECTIONS; ++l)
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
      UNROLLED_FOR(int i = 0; i < QUADS; ++i) {
        if (4 * i >= LANES * (slot + 1)) break;
        if (SKIPS_QUADS && !(quads >> i & 1)) continue;
        const Quad a = read4(n + 4 * i);
        UNROLLED_FOR(int j = 0; j < 4; ++j) h.row[slot][4 * i + j] += c * a.v[j];
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
    UNROLLED_FOR(int j = 0; j < 2; ++j) solve_two(lower, b[j], c[j], mixed[0][j], mixed[1][j]);
    factor_two(rows[0].v[0] + damping.v[0] - mixed[0][0] * b[0] - mixed[1][0] * c[0],
               rows[1].v[0] - mixed[0][1] * b[0] - mixed[1][1] * c[0],
               rows[1].v[1] + damping.v[1] - mixed[0][1] * b[1] - mixed[1][1] * c[1], upper);
  }
  INLINE void solve(const float* y, float* x) const {
    solve_two(upper, y[0] - mixed[0][0] * y[2] - mixed[1][0] * y[3], y[1] - mixed[0][1] * y[2] - mixed[1][1] * y[3],
              x[0], x[1]);
    solve_two(lower, y[2], y[3], x[2], x[3]);
    UNROLLED_FOR(int i = 0; i < 2; ++i) x[2 + i] = x[2 + i] - mixed[i][0] * x[0] - mixed[i][1] * x[1];
  }
  INLINE void write(float* p) const {
    write4(p, {upper[0], upper[1], upper[2], lower[0]});
    write4(p + 4, {mixed[0][0], mixed[0][1], mixed[1][0], mixed[1][1]});
    write4(p + 8, {lower[1], lower[2], 0.0f, 0.0f});
  }
  INLINE void read(const float* p) {
    const Quad a = read4(p), b = read4(p + 4), c = read4(p + 8);
    UNROLLED_FOR(int i = 0; i < 3; ++i) upper[i] = a.v[i];
    UNROLLED_FOR(int i = 0; i < 4; ++i) mixed[i / 2][i % 2] = b.v[i];
    lower[0] = a.v[3];
    lower[1] = c.v[0];
    lower[2] = c.v[1];
  }
};

// The owners of a block hand its rows, up to a quad of columns, to all lanes.
INLINE void hand_over(const Slots& h, const int slot, const int block, const int quads) {
  const int d = lane + LANES * slot;
  if (d >> 2 != block || d >= DOFS) return;
  UNROLLED_FOR(int i = 0; i <= quads; ++i) {
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
  ROLLED_FOR(int block = first;; --block) {
    sync();
    Quad rows[4];
    UNROLLED_FOR(int i = 0; i < 4; ++i) rows[i] = read4(w.pivots[i] + 4 * block);
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
      UNROLLED_FOR(int i = 0; i < 4; ++i) {
        own[i] = d < 4 * block ? w.pivots[i][d] : 0.0f;
        some = some || own[i] != 0.0f;
      }
      columns[slot] = ballot(some);
      b.solve(own, c[slot]);
      UNROLLED_FOR(int i = 0; i < 4; ++i) h.gradient[slot] = h.gradient[slot] - c[slot][i] * gradient.v[i];
    }
    UNROLLED_FOR(int pair = 0; 2 * pair < first; ++pair) {  // of quads
      if (!(columns[8 * pair / LANES] >> 8 * pair % LANES & 255)) continue;
      UNROLLED_FOR(int i = 2 * pair; i < 2 * pair + 2 && i < first; ++i) {
        UNROLLED_FOR(int k = 0; k < 4; ++k) rows[k] = read4(w.pivots[k] + 4 * i);
        UNROLLED_FOR(int slot = 0; LANES * slot < 4 * first; ++slot) {
          if (4 * i >= LANES * (slot + 1)) continue;
          UNROLLED_FOR(int k = 0; k < 4; ++k)
            UNROLLED_FOR(int j = 0; j < 4; ++j)
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
    UNROLLED_FOR(int i = DOFS % 4; i < 4; ++i) {
      write4(w.pivots[i] + 4 * lane, {0.0f, 0.0f, 0.0f, 0.0f});
      w.pivot_damping[i] = 1.0f;
      w.pivot_gradient[i] = 0.0f;
    }
  }
  //ELIMINATE
  sync();
  // Substitution from the first block to the last. All subtract; those who are done take no harm.
  UNROLLED_FOR(int block = 0; block < QUADS; ++block) {
    const int first = 4 * block, own = first / LANES;
    Block b;
    b.read(w.blocks[block]);
    float y[4], x[4];
    UNROLLED_FOR(int i = 0; i < 4; ++i) y[i] = first + i < DOFS ? read(h.gradient[own], (first + i) % LANES) : 0.0f;
    b.solve(y, x);
    if (lane == 0) write4(w.search + first, {x[0], x[1], x[2], x[3]});
    UNROLLED_FOR(int slot = own; slot < SLOTS; ++slot)
      UNROLLED_FOR(int i = 0; i < 4; ++i) h.gradient[slot] = h.gradient[slot] - h.row[slot][first + i] * x[i];
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
