"""The tasks: what stands around the arm, what counts as done, and by which of several routes."""

import numpy as np

from sb3_ddiffpg.envs.franka.arm import FloatArray
from sb3_ddiffpg.envs.franka.arm_env import FrankaEnv
from sb3_ddiffpg.envs.franka.bodies import GOAL, STEEL, WOOD, joint, link

QUARTERS = ("left-up", "left-down", "right-up", "right-down")


class FrankaReach(FrankaEnv):
    """
    Reach a point behind a cross of two plates: through one of the four quarters.

    The mode is the quarter in which the fingertips last crossed the cross's plane: ``"left-up"``, ``"left-down"``,
    ``"right-up"``, ``"right-down"`` (left: positive y).
    """

    listed_modes = QUARTERS
    base_x = -0.6
    start_angles = (0.0, -1.5, 0.0, -3.0, 0.0, 2.26, 0.79)
    looks_at = (-0.3, 0.0, 0.5)
    CROSS = (-0.22, 0.0, 0.67)
    GOAL = (-0.05, 0.0, 0.65)
    RADIUS = 0.1

    def _build(self) -> None:
        self._add_box(self.CROSS, (0.04, 0.01, 0.4), WOOD)
        self._add_box(self.CROSS, (0.04, 0.4, 0.01), WOOD)
        if self.render_mode is not None:
            client = self.arm.client
            marker = client.createVisualShape(client.GEOM_SPHERE, radius=self.RADIUS, rgbaColor=GOAL)
            client.createMultiBody(baseVisualShapeIndex=marker, basePosition=self.GOAL)

    def _begin(self) -> None:
        self._quarter = ""

    def _follow(self, before: FloatArray, after: FloatArray) -> None:
        plane, _, height = self.CROSS
        if (before[0] < plane) != (after[0] < plane):
            share = (plane - before[0]) / (after[0] - before[0])
            crossing = before + share * (after - before)
            self._quarter = f"{'left' if crossing[1] > 0 else 'right'}-{'up' if crossing[2] > height else 'down'}"

    def _done_by(self) -> str | None:
        position, _ = self.arm.end_effector()
        return self._quarter if np.linalg.norm(position - self.GOAL) <= self.RADIUS else None


class FrankaPegInHole(FrankaEnv):
    """
    Put the peg that the hand holds into one of two holes. The mode is the hole: ``"left"`` (positive y) or ``"right"``.

    Done is when the peg's tip is within the hole's half-width of its axis, and below the block's top.
    """

    listed_modes = closable = ("left", "right")
    base_x = -0.6
    start_angles = (0.0, 0.41, 0.0, -1.85, 0.0, 2.26, 0.79)
    default_start_noise = 0.1
    looks_at = (-0.1, 0.0, 0.2)
    HOLES = {"left": (0.05, 0.15), "right": (0.05, -0.15)}  # noqa: RUF012 - never changed
    HALF_WIDTH, TOP, DEPTH = 0.0203, 0.03, 0.025
    PEG_RADIUS, PEG_BACK, PEG_TIP = 0.0127, -0.04, 0.0965  # along the hand, from between the fingertips
    tool = (
        f"<link name='peg'><inertial><mass value='0.05'/><inertia ixx='1e-5' ixy='0' ixz='0' iyy='1e-5' iyz='0' izz='1e-5'/>"
        f"</inertial><visual><geometry><cylinder radius='{PEG_RADIUS}' length='{PEG_TIP - PEG_BACK}'/></geometry>"
        f"<material name='p'><color rgba='0.84 0.24 0.17 1'/></material></visual><collision><geometry>"
        f"<cylinder radius='{PEG_RADIUS}' length='{PEG_TIP - PEG_BACK}'/></geometry></collision></link>"
        f"<joint name='peg_joint' type='fixed'>"
        f"<parent link='panda_grasptarget'/><child link='peg'/><origin xyz='0 0 {(PEG_TIP + PEG_BACK) / 2}'/></joint>"
    )

    def _build(self) -> None:
        self._add_box((0.0, 0.0, -0.025), (0.8, 1.0, 0.05), WOOD)
        inner, outer = self.HALF_WIDTH, 0.06
        wall = outer - inner
        for name, (x, y) in self.HOLES.items():
            if name in self.changes.closed:
                self._add_box((x, y, self.TOP / 2), (2 * inner, 2 * inner, self.TOP), STEEL)
            for side in (-1, 1):
                self._add_box((x + side * (inner + wall / 2), y, self.TOP / 2), (wall, 2 * outer, self.TOP), STEEL)
                self._add_box((x, y + side * (inner + wall / 2), self.TOP / 2), (2 * inner, wall, self.TOP), STEEL)

    def tip(self) -> FloatArray:
        """
        :return: position of the peg's tip, in metres
        """
        return self.arm.end_effector()[0] + self.PEG_TIP * self.arm.hand_direction()

    def _done_by(self) -> str | None:
        x, y, z = self.tip()
        for name, (hole_x, hole_y) in self.HOLES.items():
            if np.hypot(x - hole_x, y - hole_y) <= self.HALF_WIDTH and z < self.DEPTH:
                return name
        return None


class FrankaDrawerClose(FrankaEnv):
    """
    Close one of four open drawers. The mode is the drawer: ``"left-up"``, ``"left-down"``, ``"right-up"`` or ``"right-down"``
    (left: positive y). The four openings (m) are observed, and are where routes differ: any part of the arm may push a drawer.
    """

    listed_modes = closable = QUARTERS
    feature_indices = (6, 7, 8, 9)
    cell_size = 0.01
    base_x = -1.2
    start_angles = (0.0, -1.5, 0.0, -3.0, 0.0, 2.26, 0.79)
    default_start_noise = 0.1
    n_extra = 4
    looks_at = (-0.6, 0.0, 0.5)
    DRAWERS = {  # noqa: RUF012 - never changed
        f"{side}-{level}": (-0.35, y, z)
        for side, y in (("left", 0.185), ("right", -0.185))
        for level, z in (("up", 0.68), ("down", 0.48))
    }
    SIZE = (0.3, 0.33, 0.16)
    OPENING, CLOSED, BRAKE, STUCK = 0.17, 0.03, 2.0, 1e4

    def _build(self) -> None:
        # The back wall carries the drawers
        parts = [link("base", (0.02, 0.75, 0.42), (0.0, 0.0, 0.0), WOOD)]
        for name, (x, y, z) in self.DRAWERS.items():
            parts.append(link(name, self.SIZE, (0.0, 0.0, 0.0), STEEL))
            parts.append(joint("prismatic", name, (-1.0, 0.0, 0.0), (x + 0.17, y, z - 0.58), 0.2))
        self._chest = self.arm.load(f"<robot name='chest'>{''.join(parts)}</robot>", (-0.17, 0.0, 0.58))
        for drawer, name in enumerate(self.DRAWERS):
            self._brake(self._chest, drawer, self.STUCK if name in self.changes.closed else self.BRAKE)

    def _begin(self) -> None:
        for drawer in range(4):
            self.arm.client.resetJointState(self._chest, drawer, self.OPENING)

    def _extra(self) -> FloatArray:
        return np.array([state[0] for state in self.arm.client.getJointStates(self._chest, range(4))])

    def _done_by(self) -> str | None:
        openings = self._extra()
        return list(self.DRAWERS)[int(openings.argmin())] if openings.min() <= self.CLOSED else None


class FrankaCabinetOpen(FrankaEnv):
    """
    Open a cabinet's door, which leaves a gap at its free edge, by reaching in and pulling from behind. A shelf divides the
    cabinet: the mode is where the fingertips are when the door begins to open, ``"up"`` above the shelf or ``"down"`` below.
    The door's angle (rad) is observed.
    """

    listed_modes = ("up", "down")
    base_x = -0.9
    start_angles = (-0.2, -0.5, 0.0, -2.6, 0.0, 2.2, 0.79)
    # Much stronger ones press the hand through the door
    force_scale = 10.0
    n_extra = 1
    looks_at = (-0.4, 0.0, 0.5)
    CENTER, SIZE, PLATE = (-0.22, 0.1, 0.53), (0.33, 1.0, 0.86), 0.02
    HINGE_Y, DOOR_WIDTH, DOOR_HEIGHT = 0.45, 0.45, 0.82
    OPENS, OPEN, BRAKE = 0.05, 0.4, 0.5

    def _build(self) -> None:
        (x, y, z), (depth, width, height), plate = self.CENTER, self.SIZE, self.PLATE
        self._add_box((x + depth / 2, y, z), (plate, width, height), WOOD)
        for side in (-0.5, 0.5):
            self._add_box((x, y + side * width, z), (depth, plate, height), WOOD)
        for level in (-0.5, 0.0, 0.5):
            self._add_box((x, y, z + level * height), (depth, width, plate), WOOD)
        front, panel, end = x - depth / 2 - 0.75 * plate, self.HINGE_Y + plate, y + width / 2
        self._add_box((front, (panel + end) / 2, z), (plate, end - panel, height), WOOD)
        frame = link("base", (0.01, 0.01, 0.01), (0.0, 0.0, 0.0), STEEL)
        door = link("door", (plate, self.DOOR_WIDTH, self.DOOR_HEIGHT), (0.0, -self.DOOR_WIDTH / 2, 0.0), STEEL)
        hinge = joint("revolute", "door", (0.0, 0.0, -1.0), (0.0, 0.0, 0.0), 1.6)
        self._door = self.arm.load(f"<robot name='door'>{frame}{door}{hinge}</robot>", (front, self.HINGE_Y, z))
        self._brake(self._door, 0, self.BRAKE)

    def _begin(self) -> None:
        self.arm.client.resetJointState(self._door, 0, 0.0)
        self._layer = ""

    def _extra(self) -> FloatArray:
        return np.array([self.arm.client.getJointState(self._door, 0)[0]])

    def _follow(self, before: FloatArray, after: FloatArray) -> None:
        if self._extra()[0] < self.OPENS:
            self._layer = ""
        elif not self._layer:
            self._layer = "up" if before[2] > self.CENTER[2] else "down"

    def _done_by(self) -> str | None:
        return self._layer if self._extra()[0] >= self.OPEN else None
