// ---- Friction ------------------------------------------------------------------------------------------------------

// The law of a contact with friction: gradient and Hessian of its cost, as a function of its residuals in its
// directions, which are the normal, two tangents, and turning about these three.

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
    UNROLLED_FOR(int j = 1; j < DIRECTIONS; ++j) squared += x[j] * x[j];
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
    UNROLLED_FOR(int j = 1; j < DIRECTIONS; ++j) {
      way[j] = x[j] * inverse;
      gradient[j] = off * way[j];
    }
  }
  INLINE void times(const float* v, float* product) const {  // the Hessian
    float forward = 0.0f;
    UNROLLED_FOR(int j = 1; j < DIRECTIONS; ++j) forward += way[j] * v[j];
    product[0] = square * v[0] + mixed * forward;
    const float common = mixed * v[0] + (along - across) * forward;
    UNROLLED_FOR(int j = 1; j < DIRECTIONS; ++j) product[j] = common * way[j] + across * v[j];
  }

  // A contact along a search direction v: its residual is x + alpha v.
  struct Line {
    float n, n_speed;                  // along the normal, and how it changes
    float t, forward, speed_squared;   // off it: the length of x, its product with v, the square of v
    float nearest_squared, per_speed;  // the shortest length on the way; one over the square of v, or 0
    float weight, parabola, mu;

    INLINE void set(const float* x, const float* v, float own_weight, float own_mu) {
      float squared = forward = speed_squared = 0.0f;
      UNROLLED_FOR(int j = 1; j < DIRECTIONS; ++j) {
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
      sums[0] +=
          0.5f * parabola *
          (grown(n - mu * t, beside, by_n - mu * by_t) + grown(mu * n + t, mu * next_n + next_t, mu * by_n + by_t));
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

// A pyramid. Its edges, the normal plus or minus one of the others, are rows of their own.
struct Pyramid {
  float gradient[DIRECTIONS];
  float square[DIRECTIONS], mixed[DIRECTIONS];  // of the Hessian: of each direction, and of the normal with it

  static INLINE unsigned sides(const float* x) {  // the closed ones
    unsigned found = 0;
    UNROLLED_FOR(int i = 0; i < CONTACT_ROWS; ++i) found |= (unsigned)(x[i] < 0.0f) << i;
    return found;
  }
  INLINE Pyramid(const float* x, float weight, float, unsigned sides) {
    UNROLLED_FOR(int j = 1; j < DIRECTIONS; ++j) {
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
    UNROLLED_FOR(int j = 1; j < DIRECTIONS; ++j) {
      product[0] = product[0] + mixed[j] * v[j];
      product[j] = mixed[j] * v[0] + square[j] * v[j];
    }
  }
};
#if WITH_ELLIPTIC
typedef Cone Law;
#else
typedef Pyramid Law;
#endif
