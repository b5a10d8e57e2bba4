// What the lanes of a world share, and do together.

World & w;
const int lane;
const float* const ctrl;  // of the world
int& overflow;            // of the world
const Varied varied;
const float* const terrain;  // heights of all fields

INLINE Step(World& w, int lane, const float* ctrl, int& overflow, const float* row, const float* terrain)
    : w(w), lane(lane), ctrl(ctrl), overflow(overflow), varied{{row}}, terrain(terrain) {}

#ifdef __CUDA_ARCH__
INLINE void sync() const { __syncwarp(); }
INLINE unsigned ballot(bool x) const { return __ballot_sync(~0u, x); }
INLINE bool any_of_block(bool x) const { return Model::SUBSTEPS > 0 ? __syncthreads_or(x) : x; }
INLINE float read(float x, int from) const { return __shfl_sync(~0u, x, from); }
INLINE int read(int x, int from) const { return __shfl_sync(~0u, x, from); }
INLINE unsigned read(unsigned x, int from) const { return __shfl_sync(~0u, x, from); }
// The number of a lane, which the compiler knows to be the same in all, except before Ampere.
#if __CUDA_ARCH__ >= 800
INLINE unsigned agreed(unsigned x, int from) const { return __reduce_or_sync(~0u, lane == from ? x : 0u); }
#else
INLINE unsigned agreed(unsigned x, int from) const { return __shfl_sync(~0u, x, from); }
#endif

// The sum of what the lanes below have.
INLINE int sum_below(int x) const {
  int sum = x;
  UNROLLED_FOR(int o = 1; o < 32; o <<= 1) {
    const int below = __shfl_up_sync(~0u, sum, o);
    if (lane >= o) sum += below;
  }
  return sum - x;
}

// Replaces each of n values by its sum over the lanes. With many of them, pairs of lanes first exchange halves, so
// that each lane goes on with a quarter of the values.
INLINE void sum(float* x, const int n) const {
  if (n < 6) {
    UNROLLED_FOR(int i = 0; i < n; ++i)
      UNROLLED_FOR(int o = 16; o; o >>= 1) x[i] += __shfl_xor_sync(~0u, x[i], o);
    return;
  }
  const bool odd = lane & 1, upper = lane & 2;
  float half[6], quarter[3];
  UNROLLED_FOR(int i = 0; i < (n + 1) / 2; ++i) {
    const float a = x[2 * i], b = 2 * i + 1 < n ? x[2 * i + 1] : 0.0f;
    half[i] = (odd ? b : a) + __shfl_xor_sync(~0u, odd ? a : b, 1);
  }
  UNROLLED_FOR(int i = 0; i < (n + 3) / 4; ++i) {
    const float a = half[2 * i], b = 2 * i + 1 < (n + 1) / 2 ? half[2 * i + 1] : 0.0f;
    quarter[i] = (upper ? b : a) + __shfl_xor_sync(~0u, upper ? a : b, 2);
    UNROLLED_FOR(int o = 4; o < 32; o <<= 1) quarter[i] += __shfl_xor_sync(~0u, quarter[i], o);
  }
  UNROLLED_FOR(int i = 0; i < n; ++i) x[i] = read(quarter[i / 4], i & 3);
}

// Replaces a value of each lane, and where it is, by those of the lane with the largest, or the first place of several.
INLINE void largest(float& x, int& at) const {
  ROLLED_FOR(int o = 16; o; o >>= 1) {
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
INLINE int sum_below(int) const { return 0; }
INLINE void sum(float*, const int) const {}
INLINE void largest(float&, int&) const {}
#endif
// Items that the lanes have, some each, are dealt out to all of them, one after another.
struct Item {
  int owner, number;  // the lane that has it, and which of its items it is
  bool exists;
};
INLINE Item dealt(int before, int all, int item) const {  // `before`: items of the lanes below
  int owner = 0;
  if (LANES > 1)
    UNROLLED_FOR(int o = 16; o; o >>= 1)
      if (read(before, owner + o) <= item) owner += o;
  return {owner, item - read(before, owner), item < all};
}
INLINE unsigned lanes_below() const { return (1u << lane) - 1; }
INLINE void flag(int bits) const {
  if (lane == 0 && Model::SUBSTEPS) overflow |= bits;
}

static INLINE Quad read4(const float* p) { return *reinterpret_cast<const Quad*>(p); }
static INLINE void write4(float* p, Quad q) { *reinterpret_cast<Quad*>(p) = q; }
