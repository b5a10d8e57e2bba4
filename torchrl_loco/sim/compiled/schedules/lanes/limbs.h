// The Hessian of a body with limbs, which are eliminated side by side.

#if WITH_LIMBS && defined(__CUDA_ARCH__)
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
#define OWN_ROWS(hold, row) UNROLLED_FOR(int hold = 0, row = lane; hold < HOLDS; ++hold, row += LANES)

struct Branches {
  float trunk[HOLDS][TRUNK], limb[LIMB];  // the last LIMB columns up to the end of the limb
  float diagonal[HOLDS], gradient[HOLDS];
};

struct Factors {
  float of[DIRECTIONS];
};  // of rows of the Jacobian for a row of the Hessian

static INLINE int dof_of_row(int row) { return Model::limb_row_dof(row < LIMB_ROWS + TRUNK ? row : 0); }
static INLINE int limb_columns(int row) { return Model::limb_row_end(row < LIMB_ROWS ? row : 0) - LIMB; }

static INLINE void read_trunk(const float* row, float* columns) {
  UNROLLED_FOR(int i = 0; i < QUADS; ++i) {
    bool some = false;
    UNROLLED_FOR(int k = 4 * i; k < 4 * i + 4; ++k) some = some || Model::trunk_place(k) >= 0;
    if (!some) continue;
    const Quad q = read4(row + 4 * i);
    UNROLLED_FOR(int k = 0; k < 4; ++k) {
      const int t = Model::trunk_place(4 * i + k);
      if (t >= 0) columns[t] = q.v[k];
    }
  }
}

// Adds sums over n rows of the Jacobian, each times its factor for a row of the Hessian.
INLINE void add_products(Branches& h, const float* rows, const Factors* factors, const int n) const {
  UNROLLED_FOR(int l = 0; l < n; ++l) {
    float columns[TRUNK];
    read_trunk(rows + STRIDE * l, columns);
    OWN_ROWS(hold, row) {
      UNROLLED_FOR(int t = 0; t < TRUNK; ++t) h.trunk[hold][t] = h.trunk[hold][t] + factors[hold].of[l] * columns[t];
    }
    const float* const own = rows + STRIDE * l + limb_columns(lane);
    UNROLLED_FOR(int j = 0; j < LIMB; ++j) h.limb[j] = h.limb[j] + factors[0].of[l] * own[j];
  }
}

INLINE void assemble(Branches& h, const bool with_contacts, const float* diagonal, const float* gradient) const {
  OWN_ROWS(hold, row) {
    const int d = dof_of_row(row);
    const float* const mass = w.mass + STRIDE * d;
    read_trunk(mass, h.trunk[hold]);
    if (hold == 0)
      UNROLLED_FOR(int j = 0; j < LIMB; ++j) h.limb[j] = mass[limb_columns(row) + j];
    h.diagonal[hold] = mass[d] + of_owner(diagonal, 1, SLOTS, d);
    h.gradient[hold] = of_owner(gradient, 1, SLOTS, d);
  }
  if (!with_contacts) return;
  Factors factors[HOLDS];
  CLOSED_CONTACTS(place, left, 0, OWN_FRICTIONAL) {
    const int from = lowest_bit(left), k = number(place, from);
    const Law cost = law(k, agreed(sides(place), from));
    const float* const rows = w.jacobian + DIRECTIONS * STRIDE * k;
    OWN_ROWS(hold, row) {
      float own[DIRECTIONS];
      UNROLLED_FOR(int i = 0; i < DIRECTIONS; ++i) own[i] = rows[STRIDE * i + dof_of_row(row)];
      cost.times(own, factors[hold].of);
      UNROLLED_FOR(int i = 0; i < DIRECTIONS; ++i) {
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
INLINE void solve_by_limbs(Branches& h, const bool damping_alone, float& decrement) const {
  const bool limb = lane < LIMB_ROWS;
  const int end = Model::limb_row_end(limb ? lane : 0),
            skipped = LIMB - Model::limb_length(Model::limb_of_row(limb ? lane : 0));
  const int above = limb ? end - 1 - dof_of_row(lane) : -1, place = LIMB - 1 - above;  // rows to eliminate before
  const int base = PIVOT * Model::limb_of_row(limb ? lane : 0);
  UNROLLED_FOR(int j = 0; j < LIMB; ++j)
    if (j < skipped) h.limb[j] = 0.0f;
  float before[HOLDS], whole[HOLDS], left[ENTRIES];
  OWN_ROWS(hold, row) {
    before[hold] = h.gradient[hold];
    whole[hold] = h.diagonal[hold];
    const int t = row - LIMB_ROWS;
    if (t < 0 || t >= TRUNK) continue;
    float* const corner = w.corner + LOWER + t * (t + 1) / 2;
    UNROLLED_FOR(int j = 0; j < TRUNK; ++j)
      if (j < t) corner[j] = h.trunk[hold][j];
    corner[t] = h.diagonal[hold];
    w.corner[t] = h.gradient[hold];
  }
  UNROLLED_FOR(int i = 0; i < ENTRIES; ++i) left[i] = 0.0f;
  ROLLED_FOR(int step = 0; step < LIMB; ++step) {
    float* const pivots = w.limb_pivots[step & 1];
    if (above == step) {
      const float scale = inverse_root(h.diagonal[0]);
      float row[PIVOT];
      UNROLLED_FOR(int t = 0; t < TRUNK; ++t) row[t] = h.trunk[0][t] * scale;
      row[TRUNK] = h.gradient[0] * scale;
      UNROLLED_FOR(int j = 0; j + TRUNK + 1 < PIVOT; ++j) row[TRUNK + 1 + j] = j < LIMB ? h.limb[j] * scale : 0.0f;
      UNROLLED_FOR(int i = 0; i < PIVOT; i += 4)
        write4(pivots + base + i, {row[i], row[i + 1], row[i + 2], row[i + 3]});
    }
    sync();
    if (above > step) {
      const float c = pivots[base + TRUNK + 1 + place];
      float row[PIVOT];
      UNROLLED_FOR(int i = 0; i < PIVOT; i += 4) {
        const Quad q = read4(pivots + base + i);
        UNROLLED_FOR(int k = 0; k < 4; ++k) row[i + k] = q.v[k];
      }
      UNROLLED_FOR(int t = 0; t < TRUNK; ++t) h.trunk[0][t] = h.trunk[0][t] - c * row[t];
      h.gradient[0] = h.gradient[0] - c * row[TRUNK];
      UNROLLED_FOR(int j = 0; j < LIMB; ++j) h.limb[j] = h.limb[j] - c * row[TRUNK + 1 + j];
      h.diagonal[0] = h.diagonal[0] - c * c;
    }
    UNROLLED_FOR(int i = 0; i < ENTRIES; ++i) {
      const int e = lane + LANES * i < CORNER ? lane + LANES * i : 0;
      const float *const a = pivots + Model::corner_row(e), *const b = pivots + Model::corner_column(e);
      UNROLLED_FOR(int l = 0; l < Model::LIMBS; ++l)
        if (step < Model::limb_length(l)) left[i] = left[i] + a[PIVOT * l] * b[PIVOT * l];
    }
  }
  UNROLLED_FOR(int i = 0; i < ENTRIES; ++i)
    if (lane + LANES * i < CORNER) w.corner[lane + LANES * i] -= left[i];
  sync();
  ROLLED_FOR(int k = TRUNK - 1; k >= KEPT; --k) {  // an entry a lane
    const float* const row = w.corner + LOWER + k * (k + 1) / 2;
    const float pivot = inverse(row[k]);
    UNROLLED_FOR(int n = 0; n < ENTRIES; ++n) {
      const int e = lane + LANES * n;
      if (e >= CORNER) continue;
      const int i = Model::corner_row(e), j = Model::corner_column(e);
      if (i < k) w.corner[e] -= row[i] * pivot * (j < TRUNK ? row[j] : w.corner[k]);
    }
    sync();
  }

  // H = L' D L of the rest of the trunk, and its solution.
  float kept[LOWER + KEPT_QUADS * 4], inverse[KEPT], x[TRUNK];
  UNROLLED_FOR(int i = 0; i < LOWER + KEPT_QUADS * 4; i += 4) {
    const Quad q = read4(w.corner + i);
    UNROLLED_FOR(int k = 0; k < 4; ++k) kept[i + k] = q.v[k];
  }
  float *const rest = kept, *const corner = kept + LOWER;
  UNROLLED_FOR(int k = KEPT - 1; k >= 0; --k) {
    const float* const row = corner + k * (k + 1) / 2;
    inverse[k] = Math::inverse(row[k]);
    UNROLLED_FOR(int i = 0; i < k; ++i) {
      const float c = row[i] * inverse[k];
      UNROLLED_FOR(int j = 0; j <= i; ++j) corner[i * (i + 1) / 2 + j] = corner[i * (i + 1) / 2 + j] - c * row[j];
      rest[i] = rest[i] - c * rest[k];
    }
  }
  UNROLLED_FOR(int k = 0; k < KEPT; ++k) {
    x[k] = rest[k];
    UNROLLED_FOR(int j = 0; j < k; ++j) x[k] = x[k] - corner[k * (k + 1) / 2 + j] * x[j];
    x[k] = x[k] * inverse[k];
  }
  UNROLLED_FOR(int k = KEPT; k < TRUNK; ++k) {
    const float* const row = w.corner + LOWER + k * (k + 1) / 2;
    x[k] = w.corner[k];
    UNROLLED_FOR(int j = 0; j < k; ++j) x[k] = x[k] - row[j] * x[j];
    x[k] = divide(x[k], row[k]);
  }
  float solution[HOLDS];
  bool lost = false;
  OWN_ROWS(hold, row) {
    solution[hold] = 0.0f;
    UNROLLED_FOR(int t = 0; t < TRUNK; ++t) {
      if (row != LIMB_ROWS + t) continue;
      solution[hold] = x[t];
      if (Model::DELICATE)
        lost |= is_lost(whole[hold], t < KEPT ? inverse[t] : Math::inverse(w.corner[LOWER + t * (t + 3) / 2]));
    }
  }
  // The limbs, outwards. All subtract; those who are done take no harm.
  float y = h.gradient[0];
  UNROLLED_FOR(int t = 0; t < TRUNK; ++t) y = y - h.trunk[0][t] * x[t];
  const float own_inverse = Math::inverse(h.diagonal[0]);
  if (Model::DELICATE && !damping_alone && ballot(lost | (limb & is_lost(whole[0], own_inverse)))) flag(UNSOLVED);
  UNROLLED_FOR(int j = 0; j < LIMB; ++j) {
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
