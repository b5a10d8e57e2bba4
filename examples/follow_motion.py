"""Has a robot follow a motion with an exported policy: NumPy, onnxruntime and MuJoCo, without torch and this library.

    torchrl-loco export g1_tracking --out g1.onnx
    python examples/follow_motion.py g1.onnx --clip punches

The file holds the policy and the reference; ``time_step`` is the frame. On a robot, ``read`` and ``send`` are its own.
"""

import argparse
import json

import mujoco
import numpy as np
import onnxruntime

parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
parser.add_argument("file")
parser.add_argument("--clip", help="name of the motion; default: the first")
args = parser.parse_args()
session = onnxruntime.InferenceSession(args.file)
words, text = session.get_modelmeta().custom_metadata_map, ("task", "protocol", "torchrl_loco", "mjcf")
facts = {name: word if name in text else json.loads(word) for name, word in words.items()}
if "tracking" not in facts:
    parser.error(f"{args.file} holds no policy that follows motions, such as one of g1_tracking")
clips, bodies = facts["cases"], facts["tracking"]["bodies"]
clip = args.clip or next(iter(clips))
if clip not in clips:
    parser.error(f"there is no motion {clip}: choose one of {', '.join(clips)}")
names = [output.name for output in session.get_outputs()]
base, anchor = (bodies.index(facts["tracking"][which]) for which in ("base", "anchor"))
size = sum(term["size"] for term in facts["observation"])


def ask(observation, frame):
    """Returns the action and the frame of the reference."""
    inputs = {"observation": observation[None].astype(np.float32), "time_step": np.array([frame])}
    return {name: values[0] for name, values in zip(names, session.run(names, inputs), strict=True)}


def turned(quaternion):
    """Returns the matrix of a quaternion."""
    matrix = np.zeros(9)
    mujoco.mju_quat2Mat(matrix, quaternion.astype(float))
    return matrix.reshape(3, 3)


model = mujoco.MjModel.from_xml_string(facts["mjcf"])
model.opt.timestep = facts["physics_timestep"]
data, joints = mujoco.MjData(model), facts["joints"]
first = sum(steps + 1 for steps in list(clips.values())[: list(clips).index(clip)])
start = ask(np.zeros(size), first)
data.qpos[:] = np.concatenate([start["body_pos_w"][base], start["body_quat_w"][base], start["joint_pos"]])
data.qvel[:3], data.qvel[6:] = start["body_lin_vel_w"][base], start["joint_vel"]
data.qvel[3:6] = turned(start["body_quat_w"][base]).T @ start["body_ang_vel_w"][base]
mujoco.mj_forward(model, data)
offset, scale = np.array(facts["action_offset"]), np.array(facts["action_scale"])
action, errors = np.zeros(len(scale)), []
for frame in range(first, first + clips[clip]):
    wanted, last = ask(np.zeros(size), frame), first + clips[clip]
    of_base = data.body(bodies[base]).xmat.reshape(3, 3)
    of_anchor, place = data.body(bodies[anchor]).xmat.reshape(3, 3), data.body(bodies[anchor]).xpos
    seen = {
        "reference_joints": wanted["joint_pos"],
        "reference_rates": wanted["joint_vel"],
        "anchor_position": of_anchor.T @ (wanted["body_pos_w"][anchor] - place),
        "anchor_orientation": (of_anchor.T @ turned(wanted["body_quat_w"][anchor]))[:, :2].ravel(),
        "linear_velocity": of_base.T @ data.qvel[:3],
        "angular_velocity": data.qvel[3:6],
        "joint_positions": np.concatenate([data.joint(name).qpos for name in joints]) - offset,
        "joint_velocities": np.concatenate([data.joint(name).qvel for name in joints]),
        "last_action": action,
    }
    seen["ahead"] = []
    for steps in facts["tracking"]["future"]:  # of frames ahead, where the policy sees some
        ahead = ask(np.zeros(size), min(frame + steps, last))
        own = turned(ahead["body_quat_w"][base])
        rates = [own.T @ ahead[f"body_{kind}_vel_w"][base] for kind in ("lin", "ang")]
        seen["ahead"] += [ahead["joint_pos"], ahead["joint_vel"], ahead["body_pos_w"][base, 2:], -own[2], *rates]
    seen["ahead"] = np.concatenate(seen["ahead"] or [np.zeros(0)])
    action = ask(np.concatenate([seen[term["term"]] for term in facts["observation"]]), frame)["action"]
    data.ctrl[:] = offset + scale * action
    mujoco.mj_step(model, data, round(facts["control_timestep"] / model.opt.timestep))
    mujoco.mj_kinematics(model, data)
    errors.append(np.linalg.norm(wanted["body_pos_w"] - [data.body(name).xpos for name in bodies], axis=1).mean())
print(f"{clip}: bodies were {np.mean(errors):.3f} m from the reference on average, {errors[-1]:.3f} m at the end")
