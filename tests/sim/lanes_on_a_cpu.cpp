// CUDA's words, as far as the headers of lanes have them, on a CPU: a lane of the warp is a fiber, which runs until it waits for the
// others. The body of a control step is step.inc, where "line" is that of the statement that waits. What lanes wrote
// before a shuffle or a ballot, others read after it, which CUDA promises for __syncwarp only.

#include <ucontext.h>

#include <cmath>
#include <cstdint>
#include <cstring>
using std::size_t;

enum { WARP = 32, END = 0 };
extern "C" { int lines[WARP]; }  // where each lane waits; END once its step is done
static ucontext_t home, lanes[WARP];
alignas(64) static char stacks[WARP][1 << 18];
static uint32_t given[2][WARP];  // to the others, in turns: some lanes may still have to read the last ones
static int turn[WARP], first, current, world_now;

static void run(ucontext_t& from, int lane) {
  current = lane;
  swapcontext(&from, &lanes[lane]);
}

// Lets the other lanes come here, and returns what each gives. The last one looks whether all wait at the same line.
static const uint32_t* wait(int line, uint32_t value) {
  const int self = current, next = first ? self - 1 : self + 1;
  uint32_t* const all = given[turn[self] ^= 1];
  all[self] = value;
  lines[self] = line;
  if (0 <= next && next < WARP) {
    run(lanes[self], next);
    return all;
  }
  for (int other : lines)
    if (line == END || other != line) setcontext(&home);
  run(lanes[self], first);
  return all;
}

static unsigned ballot_at(int line, bool x) {
  const uint32_t* const all = wait(line, x);
  unsigned votes = 0;
  for (int lane = 0; lane < WARP; ++lane) votes |= all[lane] << lane;
  return votes;
}

static unsigned any_at(int line, unsigned x) {
  const uint32_t* const all = wait(line, x);
  unsigned bits = 0;
  for (int lane = 0; lane < WARP; ++lane) bits |= all[lane];
  return bits;
}

template <class T>
static T shuffle_at(int line, T x, int from) {
  uint32_t bits;
  static_assert(sizeof x == sizeof bits, "a register");
  memcpy(&bits, &x, sizeof x);
  memcpy(&x, &wait(line, bits)[from % WARP], sizeof x);
  return x;
}

#define __CUDA_ARCH__ 900
#define __device__
#define __shared__
#define __forceinline__ inline
#define __ldg(pointer) (*(pointer))
#define __popc __builtin_popcount
#define __ffs __builtin_ffs
#define __clz __builtin_clz
#define __clzll __builtin_clzll
#define __syncwarp() wait(line, 0)
#define __syncthreads() wait(__LINE__, 0)
#define __syncthreads_or(x) (ballot_at(line, x) != 0)
#define __ballot_sync(mask, x) ballot_at(line, x)
#define __reduce_or_sync(mask, x) any_at(line, x)
#define __shfl_sync(mask, x, from) shuffle_at(line, x, from)
#define __shfl_xor_sync(mask, x, bits) shuffle_at(line, x, lane ^ (bits))
#define __shfl_up_sync(mask, x, by) shuffle_at(line, x, lane >= (by) ? lane - (by) : lane)
static const struct { unsigned x; } threadIdx = {0};  // of a block with one world, where only x / 32 counts

template <class T> struct Array { T* data; int shape[2]; };
extern "C" {
Array<float> ctrl_in, terrain_in, numbers_out, qpos_out, qvel_out, act_out, qacc_warmstart_out, time_out, sensordata_out;
Array<float[3]> xpos_out, subtree_com_out, contact_force_out;
Array<float[6]> cvel_out;
Array<float[9]> xmat_out;
Array<bool> in_contact_out;
Array<int> overflow_out;
}

static void advance(int world, int lane, bool live) {
#include "step.inc"
}

static void lane_main() {
  advance(world_now, current, true);
  wait(END, 0);
}

// Steps a world. Lanes run in their order, or the last one first.
extern "C" void step_world(int world, bool last_first) {
  world_now = world;
  first = last_first ? WARP - 1 : 0;
  for (int lane = 0; lane < WARP; ++lane) {
    getcontext(&lanes[lane]);
    lanes[lane].uc_stack.ss_sp = stacks[lane];
    lanes[lane].uc_stack.ss_size = sizeof stacks[lane];
    makecontext(&lanes[lane], lane_main, 0);
    turn[lane] = 0;
  }
  run(home, first);
}
