"""How a number is drawn: the distributions of a campaign, as inverse distribution functions, checked."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import stats

if TYPE_CHECKING:
    from sil_plant.config import TomlFile

# The numbers that each kind needs; normal may have low and high, which cut it off, choice may have weights.
NEEDED: dict[str, tuple[str, ...]] = {
    "constant": ("value",),
    "uniform": ("low", "high"),
    "log-uniform": ("low", "high"),
    "triangular": ("low", "mode", "high"),
    "normal": ("mean", "sd"),
    "integer": ("low", "high"),
    "choice": ("values",),
}
OPTIONAL: dict[str, tuple[str, ...]] = {"normal": ("low", "high"), "choice": ("weights",)}
RELATIVE_MEAN = 1.0  # of a normal one around the nominal value
# A normal distribution has no ends; with these many standard deviations either side it has to fit a range.
NORMAL_REACH_SD = 6.0


@dataclass(frozen=True)
class Distribution:
    """A checked distribution.

    Attributes
    ----------
    kind : str
        A key of ``NEEDED``.
    numbers : dict
        Its numbers by name.
    values, weights : tuple
        Of a choice; the weights sum up to 1.
    """

    kind: str
    numbers: Mapping[str, float]
    values: tuple[float, ...] = ()
    weights: tuple[float, ...] = ()

    @property
    def random(self) -> bool:
        """Whether chance has a say: a constant, or a choice of one, does not use up a dimension."""
        return self.kind != "constant" and len(self.values) != 1

    @property
    def support(self) -> tuple[float, float]:
        """Least and greatest value; of a normal one without ends, six standard deviations either side."""
        n = self.numbers
        if self.kind == "constant":
            return n["value"], n["value"]
        if self.kind == "choice":
            return min(self.values), max(self.values)
        if self.kind == "normal":
            reach = NORMAL_REACH_SD * n["sd"]
            return max(n["mean"] - reach, n.get("low", -math.inf)), min(n["mean"] + reach, n.get("high", math.inf))
        return n["low"], n["high"]

    def at(self, probability: np.ndarray) -> np.ndarray:
        """The values below which these shares lie: uniform numbers in, numbers of this distribution out.

        Parameters
        ----------
        probability : np.ndarray
            Each in 0 to 1.
        """
        n, u = self.numbers, np.asarray(probability, dtype=np.float64)
        if self.kind == "constant":
            return np.full(u.shape, n["value"])
        if self.kind == "choice":
            place = np.searchsorted(np.cumsum(self.weights), u, side="right")
            return np.asarray(self.values)[np.minimum(place, len(self.values) - 1)]
        if self.kind == "integer":
            count = n["high"] - n["low"] + 1.0
            return n["low"] + np.minimum(np.floor(u * count), count - 1.0)
        if self.kind == "uniform":
            return n["low"] + (n["high"] - n["low"]) * u
        if self.kind == "log-uniform":
            return np.clip(stats.loguniform.ppf(u, n["low"], n["high"]), n["low"], n["high"])
        if self.kind == "triangular":
            width = n["high"] - n["low"]
            return stats.triang.ppf(u, (n["mode"] - n["low"]) / width, n["low"], width)
        low, high = self.support
        a, b = (low - n["mean"]) / n["sd"], (high - n["mean"]) / n["sd"]
        return stats.truncnorm.ppf(u, a, b, n["mean"], n["sd"])

    def text(self) -> str:
        """The distribution in a few words."""
        if self.kind == "choice":
            return f"one of {', '.join(f'{v:g}' for v in self.values)}"
        if self.kind == "constant":
            return f"{self.numbers['value']:g}"
        n = self.numbers
        if self.kind == "normal":
            low, high = self.support
            cut = f", cut off at {low:g} and {high:g}" if "low" in n or "high" in n else ""
            return f"normal, mean {n['mean']:g}, sd {n['sd']:g}{cut}"
        mode = f", most often {n['mode']:g}" if self.kind == "triangular" else ""
        return f"{self.kind}, {n['low']:g} to {n['high']:g}{mode}"


def read_distribution(toml: TomlFile, item: Mapping[str, Any], n: int, relative: bool) -> Distribution:
    """Read and check the distribution of an entry ``[[vary]]``.

    Parameters
    ----------
    toml : TomlFile
        The spec, for messages.
    item : dict
        The entry.
    n : int
        Which one, from 0.
    relative : bool
        Whether the numbers are factors on a nominal value.

    Raises
    ------
    ConfigError
        Naming file, line, key, and what there is to choose from.
    """
    kind = item.get("distribution")
    if not isinstance(kind, str) or kind not in NEEDED:
        where = "vary.distribution" if "distribution" in item else "vary"
        what = "distribution is missing" if kind is None else f"{kind!r} is no distribution"
        raise toml.error(where, f"{what}; known are {', '.join(NEEDED)}", n)
    known = (*NEEDED[kind], *OPTIONAL.get(kind, ()))
    for key in item:
        if key not in {"key", "keys", "label", "distribution", "relative", *known}:
            raise toml.error(f"vary.{key}", f"is nothing that {kind} has; it has {', '.join(known)}", n)
    given = dict(item)
    if kind == "normal" and relative:
        given.setdefault("mean", RELATIVE_MEAN)
    for key in NEEDED[kind]:
        if key not in given:
            raise toml.error("vary", f"{kind} needs {key}", n)
    if kind == "choice":
        values = _numbers(toml, "values", given["values"], n)
        weights = _numbers(toml, "weights", given.get("weights", [1.0] * len(values)), n)
        if len(weights) != len(values) or min(weights) < 0.0 or not sum(weights) > 0.0:
            raise toml.error("vary.weights", "one weight for each value is needed, 0 or more, not all 0", n)
        return Distribution(kind, {}, values, tuple(w / sum(weights) for w in weights))
    numbers = {key: toml.number(f"vary.{key}", given[key], -1e15, 1e15, n) for key in known if key in given}
    _check_order(toml, kind, numbers, n)
    return Distribution(kind, numbers)


def _numbers(toml: TomlFile, key: str, values: Any, n: int) -> tuple[float, ...]:
    if not isinstance(values, Sequence) or isinstance(values, str) or not values:
        raise toml.error(f"vary.{key}", "a list of numbers is needed, with one at least", n)
    return tuple(toml.number(f"vary.{key}", value, -1e15, 1e15, n) for value in values)


def _check_order(toml: TomlFile, kind: str, numbers: Mapping[str, float], n: int) -> None:
    """Refuse a range without anything in it."""
    low, high = numbers.get("low", -math.inf), numbers.get("high", math.inf)
    if not low < high:
        raise toml.error("vary.low", f"the range {low:g} to {high:g} is empty: low must be below high", n)
    if kind == "log-uniform" and low <= 0.0:
        raise toml.error("vary.low", f"log-uniform needs a low above 0, not {low:g}", n)
    if kind == "triangular" and not low <= numbers["mode"] <= high:
        raise toml.error("vary.mode", f"{numbers['mode']:g} is outside {low:g} to {high:g}", n)
    if kind == "integer" and (low != round(low) or high != round(high)):
        raise toml.error("vary.low", f"integer needs whole numbers, not {low:g} to {high:g}", n)
    if kind == "normal":
        if not numbers["sd"] > 0.0:
            raise toml.error("vary.sd", f"a standard deviation above 0 is needed, not {numbers['sd']:g}", n)
        reach = NORMAL_REACH_SD * numbers["sd"]
        if numbers["mean"] - reach >= high or numbers["mean"] + reach <= low:
            raise toml.error(
                "vary.low", f"nothing of the normal distribution is left between {low:g} and {high:g}: mean and sd?", n
            )
