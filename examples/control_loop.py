"""
Drive a robot by an exported policy (``model.export_onnx("model.onnx")``), without torch and without sb3_ddiffpg: numpy and
onnxruntime are all that it imports. It holds a rate, changes the mode while it runs, and prints how well it kept the rate:

    python examples/control_loop.py model.onnx --hz 200 --seconds 10 --switch-every 1
"""

import argparse
import json
import time

import numpy as np
import onnxruntime


class Policy:
    """
    An exported policy.

    :param path: Of the file
    """

    def __init__(self, path: str) -> None:
        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        self.session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        self.about = {key: json.loads(value) for key, value in self.session.get_modelmeta().custom_metadata_map.items()}
        self.names = [mode["name"] for mode in self.about["modes"]]
        self.chooses = "mode" in {each.name for each in self.session.get_inputs()}
        # Always the same noise: the same observation, the same action. Of four actions the mode's critics choose one
        self.noise = np.array(self.about["deterministic_noise"], np.float32)[None]
        # Of a policy that says the actions of several steps at once, those that are left
        self.plan: list[np.ndarray] = []
        self.followed: str | None = None

    def __call__(self, observation: dict[str, np.ndarray], mode: str | None = None) -> np.ndarray:
        """
        :param observation: One observation, by name of the input
        :param mode: Name of the mode to follow; None leaves the choice to the policy
        :return: The action, in the environment's units
        """
        if not self.plan or mode != self.followed:
            inputs = {name: value[None] for name, value in observation.items()}
            if self.chooses:
                index = -1 if mode is None else self.names.index(mode)
                inputs["mode"] = np.array([index], np.int64)
            action = self.session.run(["action"], {**inputs, "noise": self.noise})[0][0]
            self.plan, self.followed = list(action) if self.about.get("action_chunk", 1) > 1 else [action], mode
        return self.plan.pop(0)


class Robot:
    """
    Stands in for yours: what it senses drifts with what it does.

    :param about: What the file says of the observation space
    """

    def __init__(self, about: dict) -> None:
        parts = {"observation": about} if "shape" in about else {f"observation.{key}": each for key, each in about.items()}
        self.state = {name: np.zeros(each["shape"], each["dtype"]) for name, each in parts.items()}

    def read(self) -> dict[str, np.ndarray]:
        return self.state

    def write(self, action: np.ndarray) -> None:
        for value in self.state.values():
            value += (0.01 * action.mean()).astype(value.dtype)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("model")
    parser.add_argument("--hz", type=float, default=200.0)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--switch-every", type=float, default=1.0, help="seconds in one mode")
    options = parser.parse_args()
    policy = Policy(options.model)
    robot = Robot(policy.about["observation_space"])
    print("modes:", ", ".join(policy.names) or "none")
    period, n_steps = 1.0 / options.hz, round(options.seconds * options.hz)
    late, busy = np.empty(n_steps), np.empty(n_steps)
    policy(robot.read())  # the first call allocates
    begin = time.perf_counter()
    for step in range(n_steps):
        due = begin + step * period
        # Sleep until shortly before, then wait: a sleep may be over late
        while (left := due - time.perf_counter()) > 0:
            if left > 0.001:
                time.sleep(left - 0.001)
        started = time.perf_counter()
        turn = int(step * period / options.switch_every)
        mode = policy.names[turn % len(policy.names)] if policy.names else None
        robot.write(policy(robot.read(), mode))
        late[step], busy[step] = started - due, time.perf_counter() - started
    for what, seconds in (("begins late", late), ("computes", busy)):
        median, most, worst = 1e3 * np.percentile(seconds, [50, 99, 100])
        print(f"{what:12} median {median:.3f} ms   99 % within {most:.3f} ms   worst {worst:.3f} ms")
    missed = int(np.count_nonzero(late + busy > period))
    print(f"{n_steps} steps at {options.hz:g} Hz: {missed} not done before the next was due")


if __name__ == "__main__":
    main()
