// Newton's method of both schedules, the body of a function. From a start in qacc, it leaves there the minimum of
//   1/2 (qacc - qacc_smooth)' M (qacc - qacc_smooth) + the cost of the rows.
// An iteration solves H s = -gradient, H = M + J' D J over the active rows, and searches along s. Source: MuJoCo's
// documentation, chapter Computation ("Solver algorithms", Newton). Stopping tests are those of mujoco_warp, and
// `repeated`. It reads:
//   live                    whether there is a world
//   any_of_block(x)         whether x holds here, or in a world that begins its iterations together with this one
//   GUESSES                 whether the first direction takes other rows to be active than those that are
//   set_direction(found, gradient_squared, decrement)
//                           sets s and, at its start, gradient' gradient and gradient' H^-1 gradient; once qacc is
//                           found, which is asked for if IMPLICIT_DAMPING, instead what that adds to qacc
//   project()               sets how all changes along s
//   line_search(decrement, guessed)
//                           returns a step along s; of a guess, all of s or nothing
//   move(step)              takes it, and returns whether a row is on another side than the direction took it to be; sets
//                           its improvement if the search does not
//   flag(bit)               reports what was cut short
// SCALE is one over the inertia of the model.

float gradient_squared = 0.0f, decrement = 0.0f;
const auto flat = [&](const float left) {  // with so much of both left
  const float gradient_left = SCALE * (SCALE * (gradient_squared * left));
  return (gradient_left < TOLERANCE * TOLERANCE) | (0.5f * SCALE * (decrement * left) < TOLERANCE);
};
bool found = false, done = !live;  // whether qacc is final; whether there is nothing left to do
bool same = false;                 // whether the last step left all rows on their sides
ROLLED for (int iteration = 0; any_of_block(!done); ++iteration) {
  if (done) continue;
  if (!found && iteration == ITERATIONS) {
    found = true;
    flag(LIMIT_REACHED);
  }
  done = found;
  if (done && !IMPLICIT_DAMPING) continue;
  const bool guessed = GUESSES && iteration == 0;
  set_direction(found, gradient_squared, decrement);
  if (done) continue;
  found = iteration > 0 && flat(1.0f);
  if (found) continue;
  project();
  Search step = line_search(decrement, guessed);
  found = (step.alpha == 0.0f) & !guessed;
  if (found) continue;
  const bool repeated = same;
  same = !move(step);
  found = (step.improvement > 0.0f) & (step.improvement * SCALE < TOLERANCE) & !guessed;
  if (same && !found) {  // what is left of a Newton step; of a second one on the same parabola, rounding
    // On a parabola the slope is (alpha - 1) decrement. A difference is an error of s along s; across, it may be tenfold.
    const float rest = 1.0f - step.alpha, error = 10.0f * (Math::divide(step.slope, decrement) + rest);
    found = repeated || flat(Math::larger(rest * rest, error * error));
  }
}
