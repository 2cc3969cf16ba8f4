"""A Panda arm in a pybullet world of its own."""

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

try:
    import pybullet
    import pybullet_data
    from pybullet_utils.bullet_client import BulletClient
except ImportError as error:
    raise ImportError(
        f"The Franka tasks need pybullet ({error}). It has wheels up to Python 3.11: pip install 'sb3_ddiffpg[franka]'"
    ) from error

from sb3_ddiffpg.envs.world_change import WorldChange

FloatArray = npt.NDArray[np.float64]

#: Seconds of one step of the simulator, and how many make a step of the environment (0.04 s).
TIMESTEP, N_SUBSTEPS = 1 / 500, 20
#: Largest change of a joint's target in one step, in rad.
MAX_TURN = 0.05
#: In m/s².
GRAVITY = -9.81

_FORCES = (87.0, 87.0, 87.0, 87.0, 12.0, 120.0, 120.0)
_FINGERS, _FINGER_OPENING = (9, 10), 0.015
_GRASP = 11
_ARM_FOLDER = Path(pybullet_data.getDataPath()) / "franka_panda"


@contextmanager
def _silent_stdout() -> Iterator[None]:
    """Bullet writes a line of its own for every world."""
    sys.stdout.flush()
    kept = os.dup(1)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        try:
            yield
        finally:
            os.dup2(kept, 1)
            os.close(kept)


class PandaArm:
    """
    :param base_x: where the base stands, in metres; y and z are 0
    :param with_visuals: whether it can be drawn; without, a world needs half of the memory
    :param force_scale: factor on the joints' largest forces
    :param extra_links: URDF text of links and joints that are added to the arm, such as a tool
    """

    def __init__(self, base_x: float, with_visuals: bool, force_scale: float = 1.0, extra_links: str = "") -> None:
        with _silent_stdout():
            self.client = BulletClient(pybullet.DIRECT)
        self.client.setTimeStep(TIMESTEP)
        self.client.setGravity(0.0, 0.0, GRAVITY)
        self._flags = 0 if with_visuals else pybullet.URDF_IGNORE_VISUAL_SHAPES
        text = (_ARM_FOLDER / "panda.urdf").read_text()
        text = text.replace("package://", f"{_ARM_FOLDER}/").replace("</robot>", f"{extra_links}</robot>")
        self.body = self.load(text, (base_x, 0.0, 0.0))
        self._forces = [force_scale * force for force in _FORCES]
        limits = [self.client.getJointInfo(self.body, joint)[8:10] for joint in range(7)]
        self.low, self.high = np.array(limits).T.copy()
        self.targets = np.zeros(7)

    def change(self, changes: WorldChange, start: FloatArray) -> None:
        """
        Change motors, joints, friction and gravity.

        :param changes: what is different
        :param start: angles around which a joint keeps part of its range, in rad, shape (7,)
        """
        strengths, ranges = changes.shares("motor_strength", 7), changes.shares("joint_range", 7)
        self._forces = [strength * force for strength, force in zip(strengths, self._forces, strict=True)]
        self.client.setGravity(0.0, 0.0, changes.gravity * GRAVITY)
        for joint, share in enumerate(ranges):
            if share < 1:
                self.low[joint] = start[joint] + share * (self.low[joint] - start[joint])
                self.high[joint] = start[joint] + share * (self.high[joint] - start[joint])
                limits = {"jointLowerLimit": self.low[joint], "jointUpperLimit": self.high[joint]}
                self.client.changeDynamics(self.body, joint, **limits)
        if changes.friction != 1:
            for link in range(-1, self.client.getNumJoints(self.body)):
                own = self.client.getDynamicsInfo(self.body, link)[1]
                self.client.changeDynamics(self.body, link, lateralFriction=changes.friction * own)

    def load(self, urdf: str, position: Sequence[float]) -> int:
        """
        :param urdf: text of a robot description
        :param position: of its base, which cannot move
        :return: the body's number
        """
        with TemporaryDirectory() as folder:
            path = Path(folder) / "body.urdf"
            path.write_text(urdf)
            return self.client.loadURDF(str(path), list(position), useFixedBase=True, flags=self._flags)

    def reset(self, angles: FloatArray) -> None:
        """
        :param angles: of the seven joints, at rest from now on
        """
        self.targets = np.array(angles)
        for joint, angle in enumerate(angles):
            self.client.resetJointState(self.body, joint, angle)
        for finger in _FINGERS:
            self.client.resetJointState(self.body, finger, _FINGER_OPENING)
        self._hold()

    def angles(self) -> FloatArray:
        """
        :return: of the seven joints, in rad
        """
        return np.array([state[0] for state in self.client.getJointStates(self.body, range(7))])

    def step(self, action: FloatArray) -> None:
        """
        :param action: change of the joints' targets relative to where they are, in units of ``MAX_TURN``, shape (7,)
        """
        self.targets = np.clip(self.angles() + MAX_TURN * action, self.low, self.high)
        self._hold()
        for _ in range(N_SUBSTEPS):
            self.client.stepSimulation()

    def _hold(self) -> None:
        control: Any = self.client.setJointMotorControlArray
        control(self.body, range(7), pybullet.POSITION_CONTROL, targetPositions=self.targets, forces=self._forces)
        control(self.body, _FINGERS, pybullet.POSITION_CONTROL, targetPositions=[_FINGER_OPENING] * 2, forces=[20.0, 20.0])

    def end_effector(self) -> tuple[FloatArray, FloatArray]:
        """
        :return: position (m) and velocity (m/s) of the point between the fingertips
        """
        state = self.client.getLinkState(self.body, _GRASP, computeLinkVelocity=1, computeForwardKinematics=1)
        return np.array(state[4]), np.array(state[6])

    def hand_direction(self) -> FloatArray:
        """
        :return: unit vector out of the hand, from wrist to fingertips
        """
        orientation = self.client.getLinkState(self.body, _GRASP, computeForwardKinematics=1)[5]
        return np.array(self.client.getMatrixFromQuaternion(orientation)).reshape(3, 3)[:, 2]

    def penetration(self) -> float:
        """
        :return: how deep the arm is in anything else where it now stands, in metres
        """
        self.client.performCollisionDetection()
        return max(
            (-contact[8] for contact in self.client.getContactPoints(self.body) if contact[2] != self.body), default=0.0
        )

    def close(self) -> None:
        """Release the world."""
        if self.client.isConnected():
            self.client.disconnect()
