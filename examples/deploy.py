"""Drives a robot with an exported policy: NumPy, onnxruntime and MuJoCo, without torch and this library.

    torchrl-loco export runs/go1_velocity-... --out go1.onnx
    python examples/deploy.py go1.onnx --command 0.5 0 0 --seconds 10

On a robot, ``Robot`` is what reads its sensors and sends the targets of its joints.
"""

import argparse
import collections
import json

import mujoco
import numpy as np
import onnxruntime


class Robot:
    """A robot in MuJoCo that stands in its home pose."""

    def __init__(self, facts):
        self.model = mujoco.MjModel.from_xml_string(facts["mjcf"])
        self.model.opt.timestep = facts["physics_timestep"]
        self.data, self.facts = mujoco.MjData(self.model), facts
        self.data.qpos[:] = facts["home"]
        mujoco.mj_forward(self.model, self.data)

    def read(self, last_action, command):
        d, joints = self.data, [self.data.joint(name) for name in self.facts["joints"]]
        rotation = d.body(self.facts["velocity"]["base"]).xmat.reshape(3, 3)  # from the base's frame to the world's
        return {
            "linear_velocity": rotation.T @ d.qvel[:3],
            "angular_velocity": d.qvel[3:6],
            "gravity": -rotation[2],
            "joint_positions": np.concatenate([joint.qpos for joint in joints]) - self.facts["action_offset"],
            "joint_velocities": np.concatenate([joint.qvel for joint in joints]),
            "last_action": last_action,
            "command": command,
        }

    def send(self, targets):
        self.data.ctrl[:] = targets
        mujoco.mj_step(self.model, self.data, round(self.facts["control_timestep"] / self.model.opt.timestep))
        mujoco.mj_kinematics(self.model, self.data)


parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
parser.add_argument("file")
parser.add_argument("--command", type=float, nargs=3, default=[0.5, 0, 0], help="forward, to the left, m/s; rad/s")
parser.add_argument("--seconds", type=float, default=10)
args = parser.parse_args()
session = onnxruntime.InferenceSession(args.file)
words, text = session.get_modelmeta().custom_metadata_map, ("task", "protocol", "torchrl_loco", "mjcf")
facts = {name: word if name in text else json.loads(word) for name, word in words.items()}
if "velocity" not in facts:
    parser.error(f"{args.file} holds no policy that follows a velocity command, such as one of go1_velocity")
terms = {entry["term"] for entry in facts["observation"]}
if "action_scale" not in facts or "mjcf" not in facts or "scan" in terms:
    parser.error(f"{args.file} is of a robot whose controls, model or scan of the ground need its own program")
offset, scale = np.array(facts["action_offset"]), np.array(facts["action_scale"])
low, high = (facts["velocity"][f"command_{end}"] for end in ("low", "high"))
if not ((np.array(args.command) >= low) & (np.array(args.command) <= high)).all():  # nor is NaN
    parser.error(f"the policy was trained for commands from {low} to {high}, and may fall beyond")
robot, action = Robot(facts), np.zeros(len(scale))
if unknown := terms - robot.read(action, args.command).keys():
    parser.error(f"{args.file} observes {', '.join(sorted(unknown))}, which this program does not know")
past = collections.deque(maxlen=facts["history"])  # of observations, the oldest first
for step in range(round(args.seconds / facts["control_timestep"])):
    seen = robot.read(action, args.command)
    newest = np.concatenate([seen[term["term"]] for term in facts["observation"]])
    past.extend([newest] * (past.maxlen if not past else 1))
    if step % facts["action_repeat"] == 0:
        observation = np.concatenate(past)
        action = session.run(["action"], {"observation": observation[None].astype(np.float32)})[0][0]
    robot.send(offset + scale * action)
print("base at", *robot.data.qpos[:3].round(2), "m; targets (rad):")
print(*(f"{name} {target:.2f}" for name, target in zip(facts["joints"], robot.data.ctrl, strict=True)), sep=", ")
