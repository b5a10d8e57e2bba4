// Arithmetic of both schedules: scalars, vectors and rotations.

#ifdef __CUDA_ARCH__
#define INLINE __device__ __forceinline__
#define NOINLINE __device__ __noinline__
#define UNROLLED_FOR _Pragma("unroll") for
#define ROLLED_FOR _Pragma("unroll 1") for
#else
#define INLINE inline
#define NOINLINE inline
#define UNROLLED_FOR for
#define ROLLED_FOR for
#endif

static constexpr float MINVAL = 1e-15f;  // MuJoCo's mjMINVAL
static constexpr unsigned INFINITE_BITS = 0x7f800000u, NAN_BITS = 0x7fc00000u;

struct Math {
  // Of a number and a bound; what is no number stays none, and does not become the bound. On a GPU that has an instruction
  // for it this spares a predicate, and the result is none where the bound is.
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  static INLINE float smaller(float a, float b) {
    float x;
    asm("min.NaN.f32 %0, %1, %2;" : "=f"(x) : "f"(a), "f"(b));
    return x;
  }
  static INLINE float larger(float a, float b) {
    float x;
    asm("max.NaN.f32 %0, %1, %2;" : "=f"(x) : "f"(a), "f"(b));
    return x;
  }
#else
  static INLINE float smaller(float a, float b) { return b < a ? b : a; }
  static INLINE float larger(float a, float b) { return a < b ? b : a; }
#endif
  static INLINE float clamp(float x, float low, float high) { return smaller(larger(x, low), high); }
#ifdef __CUDA_ARCH__
  // Approximate, and with denormals as zero: quicker, and near enough.
  static INLINE float divide(float a, float b) {
    float x;
    asm("div.approx.ftz.f32 %0, %1, %2;" : "=f"(x) : "f"(a), "f"(b));
    return x;
  }
  static INLINE float inverse(float a) {
    float x;
    asm("rcp.approx.ftz.f32 %0, %1;" : "=f"(x) : "f"(a));
    return x;
  }
  static INLINE float inverse_root(float x) {
    float y;
    asm("rsqrt.approx.ftz.f32 %0, %1;" : "=f"(y) : "f"(larger(x, 1e-30f)));
    return y;
  }
  static INLINE float root(float x) { return x * inverse_root(x); }
  static INLINE int bits(unsigned x) { return __popc(x); }
  static INLINE int lowest_bit(unsigned x) { return __ffs(x) - 1; }
#else
  static INLINE float divide(float a, float b) { return a / b; }
  static INLINE float inverse(float a) { return 1.0f / a; }
  static INLINE float inverse_root(float x) { return 1.0f / sqrtf(larger(x, 1e-30f)); }
  static INLINE float root(float x) { return sqrtf(x); }
  static INLINE int bits(unsigned x) { return __builtin_popcount(x); }
  static INLINE int lowest_bit(unsigned x) { return __builtin_ctz(x); }
#endif
  static INLINE float from_bits(unsigned x) {
    union {
      unsigned bits;
      float value;
    } same = {x};
    return same.value;
  }

  // x > 0 to a power, which is mostly 1 or 2.
  static INLINE float raised(float x, float power) {
    return power == 1.0f ? x : power == 2.0f ? x * x : powf(x, power);
  }
  // Sine and cosine at once: x is reduced to a quarter turn about 0 (Cody and Waite), there both are polynomials, with
  // errors below 1e-7 for angles of joints.
  static INLINE void sincos(float x, float& sine, float& cosine) {
    const float quarters = rintf(x * 0.636619772f);
    float y = fmaf(quarters, -1.57079601f, x);
    y = fmaf(quarters, -3.13916473e-7f, y);
    y = fmaf(quarters, -5.39030253e-15f, y);
    const float z = y * y;
    float s = fmaf(fmaf(2.86567956e-6f, z, -1.98559923e-4f), z, 8.33338592e-3f);
    s = fmaf(fmaf(s, z, -1.66666672e-1f), z * y, y);
    float c = fmaf(fmaf(2.44677067e-5f, z, -1.38877297e-3f), z, 4.16666567e-2f);
    c = fmaf(fmaf(c, z, -0.5f), z, 1.0f);
    const int quadrant = (int)quarters;
    sine = quadrant & 1 ? c : s;
    cosine = quadrant & 1 ? s : c;
    if (quadrant & 2) sine = -sine;
    if ((quadrant + 1) & 2) cosine = -cosine;
  }
};

struct Vec {
  float x, y, z;
  INLINE Vec operator+(Vec b) const { return {x + b.x, y + b.y, z + b.z}; }
  INLINE Vec operator-(Vec b) const { return {x - b.x, y - b.y, z - b.z}; }
  INLINE Vec operator*(float k) const { return {x * k, y * k, z * k}; }
  INLINE float dot(Vec b) const { return x * b.x + y * b.y + z * b.z; }
  INLINE Vec cross(Vec b) const { return {y * b.z - z * b.y, z * b.x - x * b.z, x * b.y - y * b.x}; }
  INLINE float norm() const { return Math::root(dot(*this)); }
  INLINE float component(int i) const { return i == 0 ? x : i == 1 ? y : z; }
  INLINE void write(float* to) const {
    to[0] = x;
    to[1] = y;
    to[2] = z;
  }
  static INLINE Vec unit(int i) { return {i == 0 ? 1.0f : 0.0f, i == 1 ? 1.0f : 0.0f, i == 2 ? 1.0f : 0.0f}; }
};

struct Quat {  // of unit length, as MuJoCo orders it
  float w, x, y, z;
  INLINE Quat operator*(Quat b) const {
    return {w * b.w - x * b.x - y * b.y - z * b.z, w * b.x + x * b.w + y * b.z - z * b.y,
            w * b.y - x * b.z + y * b.w + z * b.x, w * b.z + x * b.y - y * b.x + z * b.w};
  }
  INLINE Quat normalized() const {
    const float k = Math::divide(1.0f, Math::root(w * w + x * x + y * y + z * z));
    return {w * k, x * k, y * k, z * k};
  }
  INLINE Vec rotate(Vec v) const {
    const Vec u = {x, y, z}, t = u.cross(v) * 2.0f;
    return v + t * w + u.cross(t);
  }
  INLINE void write(float* to) const {
    to[0] = w;
    Vec{x, y, z}.write(to + 1);
  }
  // That of a matrix, given by its rows: the largest of the four comes first, whose square is not small.
  static INLINE Quat from(Vec a, Vec b, Vec c) {
    const float trace = a.x + b.y + c.z, most = Math::larger(Math::larger(a.x, b.y), Math::larger(c.z, trace));
    Quat q = {1.0f + trace, c.y - b.z, a.z - c.x, b.x - a.y};
    if (most == trace) return q.normalized();
    if (most == a.x) q = {c.y - b.z, 1.0f + a.x - b.y - c.z, a.y + b.x, a.z + c.x};
    else if (most == b.y) q = {a.z - c.x, a.y + b.x, 1.0f + b.y - a.x - c.z, b.z + c.y};
    else q = {b.x - a.y, a.z + c.x, b.z + c.y, 1.0f + c.z - a.x - b.y};
    return q.normalized();
  }
  // The rotation as a unit axis (zero at rest) and an angle of at most half a turn.
  INLINE Vec axis(float& angle) const {
    const float sine = Vec{x, y, z}.norm();
    angle = 2.0f * atan2f(sine, w);
    const bool beyond = angle > 3.14159265f;
    if (beyond) angle = 6.28318531f - angle;
    return Vec{x, y, z} * (sine > MINVAL ? Math::divide(beyond ? -1.0f : 1.0f, sine) : 0.0f);
  }
  // After a time h at an angular velocity in its own frame.
  INLINE Quat turned(Vec rate, float h) const {
    const float speed = rate.norm();
    float sine, cosine;
    Math::sincos(0.5f * h * speed, sine, cosine);
    const Vec u = rate * (speed > 0.0f ? Math::divide(sine, speed) : 0.0f);
    return (*this * Quat{cosine, u.x, u.y, u.z}).normalized();
  }
};

struct Mat {  // by rows
  Vec row0, row1, row2;
  INLINE Vec operator*(Vec v) const { return {row0.dot(v), row1.dot(v), row2.dot(v)}; }
  INLINE Vec transposed_times(Vec v) const { return row0 * v.x + row1 * v.y + row2 * v.z; }
  INLINE Vec column(int i) const { return {row0.component(i), row1.component(i), row2.component(i)}; }
  static INLINE Mat from(Quat q) {
    const float w = q.w, x = q.x, y = q.y, z = q.z;
    return {{w * w + x * x - y * y - z * z, 2.0f * (x * y - w * z), 2.0f * (x * z + w * y)},
            {2.0f * (x * y + w * z), w * w - x * x + y * y - z * z, 2.0f * (y * z - w * x)},
            {2.0f * (x * z - w * y), 2.0f * (y * z + w * x), w * w - x * x - y * y + z * z}};
  }
};

struct Symmetric {
  float xx, xy, xz, yy, yz, zz;
  INLINE Vec operator*(Vec v) const {
    return {xx * v.x + xy * v.y + xz * v.z, xy * v.x + yy * v.y + yz * v.z, xz * v.x + yz * v.y + zz * v.z};
  }
  // The same in axes turned by r: r S r'.
  INLINE Symmetric turned(Mat r) const {
    const Vec a = *this * r.row0, b = *this * r.row1, c = *this * r.row2;
    return {r.row0.dot(a), r.row0.dot(b), r.row0.dot(c), r.row1.dot(b), r.row1.dot(c), r.row2.dot(c)};
  }
};
