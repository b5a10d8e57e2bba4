// ---- The control step ----------------------------------------------------------------------------------------------

static_assert(sizeof(World) == Model::WORLD_BYTES, "layout.py counts on this size");
#ifdef __CUDA_ARCH__
static __shared__ World worlds[Model::WORLDS_PER_BLOCK];
World& w = worlds[threadIdx.x / LANES];
// The worlds of a block begin each substep, and each iteration of its solver, together: so they share what they fetch of
// the text. Lanes without a world keep to the step but do nothing else.
#define LOCKSTEP() __syncthreads()
#else
World storage;
World& w = storage;
#define LOCKSTEP()
#endif
const unsigned this_world = live ? world : 0;
const auto row_of = [=](auto* data, unsigned size) {  // products of 32 bits could wrap
  return data + static_cast<size_t>(this_world) * size;
};
float* const sensors = row_of(sensordata_out.data, Model::SENSOR_VALUES);
float* const row = row_of(numbers_out.data, numbers_out.shape[1]);
Step step(w, lane, row_of(ctrl_in.data, Model::CONTROLS), overflow_out.data[this_world], row, terrain_in.data);
if (live && lane == 0) {  // in a step that is not taken, numbers may have changed
  //DERIVE
}
if (live) {
  step.sync();  // the first lane may have written the state
  SHARED_LOOP(i, Model::POSITIONS) w.qpos[i] = row_of(qpos_out.data, Model::POSITIONS)[i];
  SHARED_LOOP(i, STRIDE) {
    w.qvel[i] = i < DOFS ? row_of(qvel_out.data, DOFS)[i] : 0.0f;
    w.qacc[i] = i < DOFS ? row_of(qacc_warmstart_out.data, DOFS)[i] : 0.0f;
    w.search[i] = 0.0f;
  }
  if (Model::ACTIVATIONS > 0)
    SHARED_LOOP(i, Model::ACTIVATIONS) w.act()[i] = row_of(act_out.data, Model::ACTIVATIONS)[i];
  SHARED_LOOP(i, DOFS * STRIDE) w.mass[i] = 0.0f;
  step.sync();
}
const int contacts = Model::HISTORY * Model::CONTACT_GEOMS;
float* const contact_forces = reinterpret_cast<float*>(row_of(contact_force_out.data, contacts));
bool* const in_contact = row_of(in_contact_out.data, contacts);
if (live && Model::SUBSTEPS == 0 &&
    Model::TOUCH + Model::CONTACT_GEOMS + Model::ACCELERATIONS > 0) {  // a step that is not taken finds forces
  step.kinematics();
  step.dynamics();
  if (Model::KEPT_CONTACTS) step.keep_contacts();
  step.solve(true);
  step.write_touch(sensors);
  ROLLED_FOR(int row = 0; Model::CONTACT_GEOMS > 0 && row < Model::HISTORY; ++row)
    step.write_contact_forces(contact_forces + 3 * Model::CONTACT_GEOMS * row, in_contact + Model::CONTACT_GEOMS * row);
  if (Model::ACCELERATIONS > 0) step.write_accelerations(sensors);
}
ROLLED_FOR(int substep = 0;; ++substep) {
  LOCKSTEP();
  if (live) step.kinematics();
  if (substep == Model::SUBSTEPS) break;
  if (live) {
    step.dynamics();
    if (Model::KEPT_CONTACTS && substep >= Model::SUBSTEPS - Model::HISTORY) step.keep_contacts();
  }
  step.solve(live);
  if (live) {
    if (Model::TOUCH && substep == Model::SUBSTEPS - 1) step.write_touch(sensors);
    const int first = Model::CONTACT_GEOMS * (substep - (Model::SUBSTEPS - Model::HISTORY));
    if (Model::CONTACT_GEOMS > 0 && first >= 0)
      step.write_contact_forces(contact_forces + 3 * first, in_contact + first);
    if (Model::ACCELERATIONS > 0 && substep == Model::SUBSTEPS - 1) step.write_accelerations(sensors);
    step.integrate();
  }
}
if (live) {
  step.write_bodies(reinterpret_cast<float*>(row_of(xpos_out.data, Model::BODIES)),
                    reinterpret_cast<float*>(row_of(xmat_out.data, Model::BODIES)),
                    cvel_out.data ? reinterpret_cast<float*>(row_of(cvel_out.data, Model::BODIES)) : nullptr);
  if (Model::SUBTREE_COM) step.write_centers(reinterpret_cast<float*>(row_of(subtree_com_out.data, Model::BODIES)));
  step.write_subtree_velocities(sensors);
  if (Model::MOTION_SENSORS > 0) step.write_velocities(sensors);
  step.write_angular_momenta(sensors);
  if (Model::SUBSTEPS > 0) {
    SHARED_LOOP(i, Model::POSITIONS) row_of(qpos_out.data, Model::POSITIONS)[i] = w.qpos[i];
    if (Model::ACTIVATIONS > 0)
      SHARED_LOOP(i, Model::ACTIVATIONS) row_of(act_out.data, Model::ACTIVATIONS)[i] = w.act()[i];
    SHARED_LOOP(i, DOFS) {
      row_of(qvel_out.data, DOFS)[i] = w.qvel[i];
      row_of(qacc_warmstart_out.data, DOFS)[i] = w.qacc[i];
    }
    if (lane == 0) time_out.data[this_world] += Model::SUBSTEPS * Model::timestep();
  }
  step.sync();  // the first lane may read it
}
