"""Where the parts of an arm are, for drawing it: from the numbers of its machine file and its joint angles.

The swing turns about a vertical axis, the wrist about a horizontal one. What a machine file does not tell, because it
does not matter there, is chosen here to look like an arm: the height of the base, the width of the links, and the
direction in which a cylinder's crank triangle lies. Its sides and its angle are the file's, so a cylinder drawn is as
long as it is. Metres; z is up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from sil_plant.inputs.machine import Machine

STEEL_KG_M3 = 7850.0
_HORN_RAD = (-1.05, -1.19)  # direction of the crank on the moving link, against the link


def ball_radius_m(mass_kg: float) -> float:
    """Radius of a steel ball of this mass; 0 for none, and for an estimate below zero."""
    return (3.0 * max(mass_kg, 0.0) / (4.0 * math.pi * STEEL_KG_M3)) ** (1.0 / 3.0)


@dataclass(frozen=True)
class Cylinder:
    """One cylinder in the plane of its crank triangle; the joint's axis is the origin, the link at angle 0 along x.

    Attributes
    ----------
    anchor : np.ndarray
        Where the barrel is held, shape (2,).
    crank_m : float
        From the joint's axis to the rod's end.
    horn_rad : float
        Direction of the crank when the joint's angle is 0.
    barrel_m, rod_m : float
        Lengths drawn.
    barrel_radius_m, rod_radius_m : float
        Bore and rod, the barrel with its wall.
    """

    anchor: np.ndarray
    crank_m: float
    horn_rad: float
    barrel_m: float
    rod_m: float
    barrel_radius_m: float
    rod_radius_m: float

    def end(self, angle_rad: float) -> np.ndarray:
        """Where the rod's end is, shape (2,)."""
        direction = angle_rad + self.horn_rad
        return self.crank_m * np.array([math.cos(direction), math.sin(direction)])

    def length_m(self, angle_rad: float) -> float:
        """From anchor to rod end."""
        return float(np.linalg.norm(self.end(angle_rad) - self.anchor))

    def direction_rad(self, angle_rad: float) -> float:
        """In which the rod leaves the barrel."""
        x, y = self.end(angle_rad) - self.anchor
        return math.atan2(y, x)


@dataclass(frozen=True)
class Geometry:
    """An arm to draw.

    Attributes
    ----------
    base_m : float
        Height of the swing's axis' upper end, where the links are.
    links_m : tuple
        Lengths of swing and wrist.
    width_m : float
        Of the links.
    cylinders : tuple of Cylinder
        Of swing (in a horizontal plane) and wrist (in the vertical plane of the arm).
    range_rad : tuple
        Lowest and highest angle of each joint.
    """

    base_m: float
    links_m: tuple[float, float]
    width_m: float
    cylinders: tuple[Cylinder, Cylinder]
    range_rad: tuple[tuple[float, float], tuple[float, float]]

    def tip(self, angles_rad: tuple[float, float]) -> np.ndarray:
        """Where the load hangs, shape (3,)."""
        swing, wrist = angles_rad
        reach = self.links_m[0] + self.links_m[1] * math.cos(wrist)
        return np.array(
            [
                reach * math.cos(swing),
                reach * math.sin(swing),
                self.base_m + self.links_m[1] * math.sin(wrist),
            ]
        )


def geometry(machine: Machine) -> Geometry:
    """Read an arm's geometry from its machine."""
    links = machine.pair("*.link_length_m")
    return Geometry(
        base_m=1.15 * links[1],
        links_m=links,
        width_m=0.055 * (links[0] + links[1]),
        cylinders=(_cylinder(machine, "swing", _HORN_RAD[0]), _cylinder(machine, "wrist", _HORN_RAD[1])),
        range_rad=tuple((machine[f"{j}.q_min_rad"], machine[f"{j}.q_max_rad"]) for j in ("swing", "wrist")),
    )


def _cylinder(machine: Machine, joint: str, horn_rad: float) -> Cylinder:
    # The longer side of the triangle is the fixed one; the cylinder's length is the same either way.
    crank, fixed = sorted((machine[f"{joint}.crank_a_m"], machine[f"{joint}.crank_b_m"]))
    opening = machine[f"{joint}.crank_q0_rad"]
    direction = horn_rad - opening
    shortest, longest = (
        math.sqrt(crank**2 + fixed**2 - 2.0 * crank * fixed * math.cos(machine[f"{joint}.{end}"] + opening))
        for end in ("q_min_rad", "q_max_rad")
    )
    barrel = min(max(0.7 * shortest, 1.1 * (longest - shortest)), 0.95 * shortest)
    return Cylinder(
        anchor=fixed * np.array([math.cos(direction), math.sin(direction)]),
        crank_m=crank,
        horn_rad=horn_rad,
        barrel_m=barrel,
        rod_m=longest - 0.92 * barrel,
        barrel_radius_m=0.6 * machine[f"{joint}.bore_m"],
        rod_radius_m=0.5 * machine[f"{joint}.rod_m"],
    )
