// The line search of both schedules, the body of a function: the cost along the search direction is convex, and
// quadratic in pieces. The direction is a step of Newton's method, so its slope at alpha = 0 is minus the decrement, its
// curvature there the decrement, and the first point that is tried is alpha = 1. It reads:
//   decrement                   gradient' H^-1 gradient
//   guessed                     whether these are of rows that were guessed to be active: then it is alpha = 1 or nothing
//   quadratic[3]                slope and curvature of the quadratic form, and the squared length of the direction
//   whole[4]                    of all rows the cost at alpha = 0, and at alpha = 1 what add_rows adds
//   add_rows(alphas, n, sums)   adds three numbers for each of n steps, over all rows
// A step of length 0 has the slope at alpha = 0 where no other is acceptable, and 0 where that slope is rounding.
// By slopes nothing adds the first of these three, the change of cost: what a step gains is for who takes it to say.

const float slope = quadratic[0], curvature = quadratic[1], near = Model::ls_near();
const Point start = {0.0f, 0.0f, -decrement, fabsf(decrement)};
// Slopes below `noise` are rounding: the sums behind them are that large.
const float tolerance =
    Math::larger(Model::ls_tolerance() * Math::divide(Math::root(quadratic[2]), Model::scale()), 1e-6f);
const float sizes = Math::root(2.0f * whole[0] * Math::larger(start.curvature - curvature, 0.0f)) + fabsf(slope);
const float noise = 8.0f * 1.1920929e-7f * sizes, accept = Math::larger(tolerance, noise);
Search result = {0.0f, 0.0f, 0.0f};
const Point first = Point::at(1.0f, slope, curvature, whole + 1);
if (guessed) {  // the decrement is not the slope at alpha = 0, where other rows are active
  result.take(first, true);
  return result;
}
if (fabsf(start.slope) < noise) return result;
result.slope = start.slope;

// Newton's method between two slopes of different sign: it is exact once it knows which rows are active.
if (Model::BY_SLOPES) {
  float low = 0.0f, high = Math::from_bits(INFINITE_BITS);
  // Where the cost rises, a step leaves what is rounding of alpha: a heavy row may begin just before p.
  const auto step = [&](const Point& p) {
    const float left = -p.slope * Math::inverse(p.curvature);
    return p.slope > 0.0f ? Math::smaller(left, -1e-6f * p.alpha) : Math::smaller(left, high - p.alpha);
  };
  // Whether p is the minimum, or what is left to it is rounding of alpha.
  const auto found = [&](const Point& p, float left) {
    return (fabsf(p.slope) < accept) | ((fabsf(left) < 1.5e-6f * p.alpha) & (p.slope < 0.1f * decrement));
  };
  float left = step(first);
  Point last = first;
  bool flat = found(first, left), stuck = false, ends = flat | (Model::LS_ITERATIONS == 0);
  ROLLED_FOR(int more = 3 * Model::LS_ITERATIONS; !ends; --more) {
    low = last.slope < 0.0f ? last.alpha : low;
    high = last.slope < 0.0f ? high : last.alpha;
    const float next = last.alpha + left;
    const float alphas[1] = {((next > low) & (next < high)) ? next : 0.5f * (low + high)};
    stuck = (alphas[0] == low) | (alphas[0] == high);
    float sums[3] = {0.0f, 0.0f, 0.0f};
    add_rows(alphas, 1, sums);
    last = Point::at(alphas[0], slope, curvature, sums);
    left = step(last);
    flat = found(last, left);
    ends = flat | stuck | (more == 1);
  }
  const bool falls = (flat | (last.slope < 0.0f)) & !stuck;  // the cost does, up to the last step
  result = {falls ? last.alpha : low, 0.0f, falls ? last.slope : start.slope};
  return result;
}
result.take(first, first.ends(start, accept, near));
if (near > 0.0f && Model::LS_ITERATIONS > 3) {  // a step at a time: most searches end with the first or the second
  Point low = start, high = start, last = first;
  bool ends = result.improvement > 0.0f, between = false;  // whether the minimum lies between low and high
  result.take(first, true);
  ROLLED_FOR(int i = 0; i < Model::LS_ITERATIONS && !ends; ++i) {
    if (last.slope < 0.0f) {
      low = last;
    } else {
      high = last;
      between = true;
    }
    float alphas[1] = {last.newton()};
    if (between && !(alphas[0] > low.alpha && alphas[0] < high.alpha)) alphas[0] = 0.5f * (low.alpha + high.alpha);
    if (alphas[0] == last.alpha || alphas[0] == low.alpha || alphas[0] == high.alpha) break;
    float sums[3] = {0.0f, 0.0f, 0.0f};
    add_rows(alphas, 1, sums);
    last = Point::at(alphas[0], slope, curvature, sums);
    ends = last.ends(start, accept, near);
    result.take(last, true);
  }
  return result;
}
const bool less = first.slope < start.slope;
Point low = less ? first : start, high = less ? start : first;
bool found = result.improvement > 0.0f;
ROLLED_FOR(int i = 0; i < Model::LS_ITERATIONS && !found; ++i) {
  // Newton's step from the start led here.
  const float from_low = i > 0 ? low.newton() : low.secant(high);
  const float alphas[3] = {from_low, high.newton(), 0.5f * (low.alpha + high.alpha)};
  float sums[9] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
  add_rows(alphas, 3, sums);
  const Point next_low = Point::at(alphas[0], slope, curvature, sums);
  const Point next_high = Point::at(alphas[1], slope, curvature, sums + 3);
  const Point middle = Point::at(alphas[2], slope, curvature, sums + 6);
  const bool low_ends = next_low.ends(start, accept, near), high_ends = next_high.ends(start, accept, near);
  const bool middle_ends = middle.ends(start, accept, near);
  found = low_ends | high_ends | middle_ends;
  if (found) {
    result = {0.0f, 0.0f, start.slope};
    result.take(next_low, low_ends);
    result.take(next_high, high_ends);
    result.take(middle, middle_ends);
  } else {
    bool moved = low.move(next_low, low.outside(next_low));
    moved |= low.move(middle, low.outside(middle));
    moved |= low.move(next_high, low.outside(next_high));
    moved |= high.move(next_high, high.outside(next_high) | ((high.slope < 0.0f) & (next_high.slope > 0.0f)));
    moved |= high.move(middle, high.outside(middle));
    moved |= high.move(next_low, high.outside(next_low));
    if ((low.cost < 0.0f) | (high.cost < 0.0f)) {
      const bool lower = low.cost < high.cost;
      result = {lower ? low.alpha : high.alpha, -Math::smaller(low.cost, high.cost), lower ? low.slope : high.slope};
    }
    found = !moved | (low.flat(tolerance) & (low.slope < 0.0f)) | (high.flat(tolerance) & (high.slope > 0.0f));
  }
}
return result;
