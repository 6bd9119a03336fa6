"""Operations that the arithmetic of one tick needs, counted from the sizes of its parts.

Multiplications, additions, divisions and roots of the equations, both joints, law DIARC, both joints moving, the gate
open. What is constant is folded beforehand, what two places need is counted once. Not counted: loads, stores, calls,
comparisons, limits, saturation, frames. A division by a constant counts as a multiplication.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

JOINTS = 2
BALANCED = 0.25  # of the ticks balance a joint's mechanics: one window of the estimator is four ticks
THETA_M, THETA_H = 9, 5
# row_parameter in arm_model.c and hydraulic_parameter in estimator.c: where a row's columns are in theta
MECHANICS = ((0, 1, 2, 3, 5, 7), (0, 1, 2, 4, 6, 8))
HYDRAULICS = ((0, 1, 2), (0, 3, 4))
ROW_COLUMNS, HYDRAULIC_COLUMNS = len(MECHANICS[0]), len(HYDRAULICS[0])
TERMS = 5  # of the odd polynomials for sine and arctangent


@dataclass(frozen=True)
class Operations:
    """How many of each kind; means over ticks need not be whole."""

    mul: float = 0.0
    add: float = 0.0
    div: float = 0.0
    root: float = 0.0

    def __add__(self, other: Operations) -> Operations:
        return Operations(self.mul + other.mul, self.add + other.add, self.div + other.div, self.root + other.root)

    def __rmul__(self, times: float) -> Operations:
        return Operations(times * self.mul, times * self.add, times * self.div, times * self.root)

    def weighed(self, cost: Operations) -> float:
        """Instructions, when each kind takes as many as ``cost`` says."""
        return self.mul * cost.mul + self.add * cost.add + self.div * cost.div + self.root * cost.root


# Instructions for one operation. With an FPU one each. In fixed point a product is smull, two additions for the
# rounding, and a shift of 64 bits in two; a quotient of 64 by 32 bits is a udiv for the first digits and Newton steps
# for the rest, a root the same with one step more.
COST = {"float": Operations(1, 1, 1, 1), "fixed": Operations(5, 1, 20, 30)}


def polynomial(terms: int) -> Operations:
    """An odd polynomial by Horner's rule, with the square of its argument."""
    return Operations(mul=terms + 1, add=terms - 1)


LOW_PASS = Operations(mul=2, add=4)  # both poles
LOW_PASS_OF_RATE = Operations(mul=3, add=4)  # of a difference quotient alone
LOW_PASS_OF_BOTH = Operations(mul=4, add=7)
GATE = Operations(mul=1)
LEVERS = Operations(mul=3)  # lever^2 w, lever s(w)
FRICTION = LEVERS + Operations(mul=1, div=1) + polynomial(TERMS) + Operations(add=1)  # and the arctangent of a ratio
CENTRIFUGAL = Operations(mul=9, add=2)  # and gravity, of the wrist's row


def ud_update(size: int, columns: Sequence[int]) -> Operations:
    """Bierman's update for a row that is zero but in some columns: U' phi, then column by column of U."""
    products = sum(size - 1 - k for k in columns)
    pairs = size * (size - 1) // 2
    return (
        Operations(mul=products, add=products)  # f = U' phi
        + size * Operations(mul=2, add=1)  # v = D f, alpha += v f
        + size * Operations(mul=1)  # f / alpha before
        + pairs * Operations(mul=2, add=2)  # U -= ., P phi += v u
        + size * Operations(div=1)  # 1 / alpha
        + size * Operations(mul=2)  # D alpha before / alpha
        + size * Operations(mul=1)  # K
    )


def row_update(size: int, columns: Sequence[int]) -> Operations:
    """Residual, scaled columns, factors, and theta += scale K residual."""
    count = len(columns)
    return Operations(mul=2 * count, add=count) + ud_update(size, columns) + size * Operations(mul=2, add=1)


def terms() -> list[tuple[str, Operations]]:
    """Name and operations of every part of a tick, both joints together."""
    with_rate = Operations(add=1) + GATE + LOW_PASS_OF_RATE
    with_both = Operations(add=1) + 2 * GATE + LOW_PASS_OF_BOTH
    plain = GATE + LOW_PASS
    innovation_test = Operations(mul=2)  # compared as squares
    rows = [row_update(THETA_M, columns) + innovation_test for columns in MECHANICS]
    rows += [row_update(THETA_H, columns) for columns in HYDRAULICS]
    mean_row = (1.0 / len(rows)) * sum(rows, Operations())
    step_of_estimate = ROW_COLUMNS * Operations(mul=1, add=2)
    return [
        ("samples to per unit, set-points to raw", Operations(mul=12, add=6)),
        ("reference: polynomial of 7th degree, two derivatives", JOINTS * Operations(mul=15, add=6)),
        ("error and its observer", JOINTS * Operations(mul=3, add=5)),
        ("sine and cosine: wrist measured and wanted, two triangles", 8 * (polynomial(TERMS) + Operations(add=1))),
        ("radius of the tip, measured and wanted", 2 * Operations(mul=1, add=1)),
        ("cylinder: length, lever, volumes", JOINTS * Operations(mul=6, add=7, div=3, root=1)),
        ("force, flow, leakage, valve gain of one sign", JOINTS * Operations(mul=9, add=8, root=2)),
        ("samples of the window", JOINTS * Operations(mul=3)),
        (
            "windows: rates, trigonometry, mean torque",
            BALANCED * (JOINTS * Operations(mul=4, add=14) + 3 * Operations(mul=1, add=1)),
        ),
        ("momentum, both rows", BALANCED * Operations(mul=8)),
        ("forces, both rows", BALANCED * (CENTRIFUGAL + JOINTS * LEVERS)),
        ("filters of the swing's row", BALANCED * (3 * with_rate + 2 * plain + with_both + Operations(mul=1))),
        ("filters of the wrist's row", BALANCED * (2 * with_both + 4 * plain + Operations(mul=1))),
        ("gate and its filter", BALANCED * JOINTS * (LOW_PASS + Operations(mul=2, add=1)) + Operations(add=1)),
        (
            "hydraulic rows and their filters",
            JOINTS * (Operations(mul=10, add=12, div=1) + with_rate + 3 * plain),  # every tick
        ),
        ("update of one row of four in turn, mean: residual, UD factors, theta", mean_row),
        ("rate limit of the estimate", (THETA_M + THETA_H) * Operations(add=2)),
        ("inverse dynamics, swing", Operations(mul=15, add=3) + FRICTION),
        ("inverse dynamics, wrist", Operations(mul=1, add=2) + CENTRIFUGAL + FRICTION),
        (
            "torque, its bound, its step",
            JOINTS * (step_of_estimate + 2 * ROW_COLUMNS * Operations(mul=1, add=1)),
        ),
        ("inertia, flow offsets and their bounds", Operations(mul=4, add=4) + JOINTS * Operations(mul=4, add=2)),
        ("uncertainty of 1/be as a share of it", Operations(div=1)),
        ("DIARC step 1 and 2", JOINTS * Operations(mul=27, add=21, div=1)),
        ("opening, robust integrals", JOINTS * Operations(mul=4, add=5, div=1)),
        ("spool: overlap and lead", JOINTS * Operations(mul=3, add=3)),
    ]


def total() -> Operations:
    """All of a tick."""
    return sum((operations for _, operations in terms()), Operations())


def floor(scalar: str) -> int:
    """Instructions that the operations alone take with a number type."""
    return round(total().weighed(COST[scalar]))
