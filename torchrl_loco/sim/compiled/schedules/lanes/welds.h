// Welds and connections of two bodies: rows of how far apart two points are, along the axes of the world, and of the vector
// part of the quaternion between two frames, about the axes of the second.

struct WeldRow {
  Vec point;
  Vec other;  // the second point; of a row about an axis, what a rotation of the first body changes it along
  float distance;
};
struct WeldFrames {
  Mat second;  // its axes, by rows
  Quat turn;   // of the first in the second
};

INLINE WeldFrames weld_frames(int weld) const {
  const Mat first = Model::weld_first_turn(weld), second = Model::weld_second_turn(weld);
  const Pose pose = pose_of(Model::weld_first_link(weld)), other = pose_of(Model::weld_second_link(weld));
  Vec rows[3], axes[3];
  UNROLLED_FOR(int k = 0; k < 3; ++k) axes[k] = other.orientation * second.column(k);
  UNROLLED_FOR(int k = 0; k < 3; ++k) rows[k] = first.transposed_times(pose.orientation.transposed_times(axes[k]));
  return {{axes[0], axes[1], axes[2]}, Quat::from(rows[0], rows[1], rows[2])};
}

// In coordinates about the centre of mass of the first tree.
INLINE WeldRow weld_row(int i) const {
  const int weld = Model::weld_of_row(i), axis = Model::weld_axis(i) % 3;
  const Pose first = pose_of(Model::weld_first_link(weld)), second = pose_of(Model::weld_second_link(weld));
  const Vec point = first.position + first.orientation * Model::weld_first_point(weld) - w.com[0];
  const Vec other = second.position + second.orientation * Model::weld_second_point(weld) - w.com[0];
  if (Model::weld_axis(i) < 3) return {point, other, (point - other).component(axis)};
  const WeldFrames frames = weld_frames(weld);
  const Vec v = {frames.turn.x, frames.turn.y, frames.turn.z};
  const Vec unit = Vec::unit(axis);
  const float scale = Model::weld_scale(weld);
  const Vec turning = (unit * frames.turn.w + v.cross(unit)) * (0.5f * scale);
  return {point, frames.second.transposed_times(turning), scale * v.component(axis)};
}

INLINE Vec weld_acceleration(int link, Vec point, Motion acceleration) const {
  if (link < 0) return {0.0f, 0.0f, 0.0f};
  return acceleration_at(acceleration, w.velocity[link], point + w.com[0] - w.com[Model::tree(link)]);
}

// Sets how fast the rows would change their velocity at qacc = 0, from the accelerations of the own links there.
INLINE void accelerate_welds(const Motion* accelerations) {
  ROLLED_FOR(int base = 0; base < Model::WELD_ROWS; base += LANES) {
    const int i = base + lane < Model::WELD_ROWS ? base + lane : 0, weld = Model::weld_of_row(i);
    const int axis = Model::weld_axis(i) % 3, link = Model::weld_first_link(weld),
              other = Model::weld_second_link(weld);
    const Motion first = of_link(accelerations, link < 0 ? 0 : link),
                 second = of_link(accelerations, other < 0 ? 0 : other);
    const Vec none = {0.0f, 0.0f, 0.0f};
    float bias;
    if (Model::weld_axis(i) < 3) {
      const WeldRow row = weld_row(i);
      bias = (weld_acceleration(link, row.point, first) - weld_acceleration(other, row.other, second)).component(axis);
    } else {
      const WeldFrames frames = weld_frames(weld);
      const Vec v = {frames.turn.x, frames.turn.y, frames.turn.z};
      const Vec turning = velocity_of(link).angular, about = velocity_of(other).angular;
      const Vec between = turning - about;
      const Vec change = (link < 0 ? none : first.angular) - (other < 0 ? none : second.angular) - about.cross(turning);
      const Vec u = frames.second * change;
      const Vec half = (u * frames.turn.w + u.cross(v)) * 0.5f - v * (0.25f * between.dot(between));
      bias = Model::weld_scale(weld) * half.component(axis);
    }
    if (base + lane < Model::WELD_ROWS) w.weld_bias()[i] = bias;
  }
  sync();
}
