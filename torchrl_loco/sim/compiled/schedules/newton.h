// Newton's method of both schedules, the body of a function. From a start in qacc, it leaves there the minimum of
//   1/2 (qacc - qacc_smooth)' M (qacc - qacc_smooth) + the cost of the rows.
// An iteration solves H s = -gradient, H = M + J' D J over the active rows, and searches along s. Source: MuJoCo's
// documentation, chapter Computation ("Solver algorithms", Newton). Stopping tests are those of mujoco_warp, and
// `repeated`. It reads:
//   live                    whether there is a world
//   any_of_block(x)         whether x holds here, or in a world that begins its iterations together with this one
//   guesses                 whether the first direction takes other rows to be active than those that are
//   Model::DELICATE         whether single precision may not be enough for H: then the diagonal of M helps where it is not
//   set_direction(found, regularisation, gradient_squared, decrement)
//                           sets s and, at its start, gradient' gradient and gradient' H^-1 gradient, with so much of the
//                           diagonal of M added to H; once qacc is found, which is asked for if
//                           Model::IMPLICIT_DAMPING, instead what that adds to qacc
//   project()               sets how all changes along s
//   line_search(decrement, guessed)
//                           returns a step along s; of a guess, all of s or nothing
//   move(step)              takes it, and returns whether a row is on another side than the direction took it to be; sets
//                           its improvement if the search does not
//   lose()                  makes the first of qacc no number, and with it the state
//   flag(bits)              reports what was cut short
// Model::scale() is one over the inertia of the model.
// A solve that fails is flagged. Where there are no numbers, or no step though MUCH is left to gain, the world is lost.

const float MUCH = 1.0f;  // mean square of an acceleration (rad^2/s^4, m^2/s^4)
float gradient_squared = 0.0f, decrement = 0.0f, regularisation = 0.0f, before = 0.0f;
const auto flat = [&](const float left) {  // with so much of both left
  const float gradient_left = Model::scale() * (Model::scale() * (gradient_squared * left));
  const bool gained = (0.5f * Model::scale() * (decrement * left) < Model::tolerance()) & (regularisation == 0.0f);
  return (gradient_left < Model::tolerance() * Model::tolerance()) | gained;
};
bool found = false, done = !live;  // whether qacc is final; whether there is nothing left to do
bool same = false;                 // whether the last step left all rows on their sides
int failures = 0;                  // bits to flag
ROLLED_FOR(int iteration = 0; any_of_block(!done); ++iteration) {
  if (done) continue;
  if (!found && iteration == Model::ITERATIONS) {
    found = true;
    failures |= LIMIT_REACHED;
  }
  done = found;
  if (done && !Model::IMPLICIT_DAMPING) continue;
  const bool guessed = guesses && iteration == 0;
  set_direction(found, regularisation, gradient_squared, decrement);
  if (done) continue;
  const float gain = 0.5f * Model::scale() * decrement;
  if (!(gain > -Model::tolerance())) {  // a pivot is no number, or not positive
    failures |= UNSOLVED;
    if (Model::DELICATE && decrement < 0.0f && regularisation < 1e6f) {
      regularisation = 10.0f * regularisation + 1.0f;
      continue;
    }
    if (!(gain > -MUCH)) lose();
    found = true;
    continue;
  }
  found = iteration > 0 && flat(1.0f);
  if (found) continue;
  project();
  Search step = line_search(decrement, guessed);
  if ((step.alpha == 0.0f) & !guessed) {
    if (gain > MUCH) lose();
    if ((step.slope != 0.0f) | (gain > MUCH)) failures |= UNSOLVED;
    found = true;
    continue;
  }
  const bool repeated = same;
  same = !move(step);
  found = (step.improvement > 0.0f) & (step.improvement * Model::scale() < Model::tolerance()) & !guessed;
  if (same && !found) {  // what is left of a Newton step; of a second one on the same parabola, rounding
    // On a parabola the slope is (alpha - 1) decrement. A difference is an error of s along s; across, it may be tenfold.
    const float rest = 1.0f - step.alpha, error = 10.0f * (Math::divide(step.slope, decrement) + rest);
    if (Model::DELICATE && repeated && decrement > 1e-3f * before)
      failures |= UNSOLVED;  // steps of Newton's method gain far more
    found = repeated || flat(Math::larger(error * error, rest * rest));
  }
  before = decrement;
}
if (failures) flag(failures);
