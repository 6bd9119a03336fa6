"""What the ECU's fault codes mean: the one table, can_protocol/faults.toml, for tools that tell people."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from pathlib import Path

from sil_plant.config import ROOT, TomlFile

FAULTS_PATH = ROOT / "can_protocol" / "faults.toml"


@dataclass(frozen=True)
class FaultText:
    """A fault in words.

    Attributes
    ----------
    code, name : int, str
        As on TIMING and in EMCY.
    reaction : str
        ``degrade``, ``safe_stop`` or ``valves_off``.
    when, clear : str
        The condition, and what to do about it.
    """

    code: int
    name: str
    reaction: str
    when: str
    clear: str

    @property
    def stops(self) -> bool:
        """Whether the arm stops for it."""
        return self.reaction != "degrade"


@functools.cache
def fault_texts(path: Path = FAULTS_PATH) -> dict[int, FaultText]:
    """Every fault the ECU knows, by its code.

    Raises
    ------
    ConfigError
        When the table cannot be read.
    """
    rows = TomlFile(path).data["fault"]
    return {
        row["code"]: FaultText(row["code"], row["name"], row["reaction"], row["when"], row["clear"]) for row in rows
    }


def fault_text(code: int) -> FaultText:
    """One fault; a code that the table does not have is told as such."""
    unknown = FaultText(
        code,
        f"FAULT_{code}",
        "valves_off",
        "this code is not in can_protocol/faults.toml here: the firmware is of another version",
        "use the tools of the firmware's release, or build the firmware from this tree (make firmware)",
    )
    return fault_texts().get(code, unknown)
