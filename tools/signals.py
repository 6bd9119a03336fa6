"""What the programs here do about signals."""

from __future__ import annotations

import signal
from types import FrameType


def take_for_interrupt(*numbers: signal.Signals) -> None:
    """Treat these signals as Ctrl-C."""
    for number in numbers:
        signal.signal(number, _interrupt)


def _interrupt(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
