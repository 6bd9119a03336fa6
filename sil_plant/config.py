"""TOML files with messages that name the file, the line, the key and the range."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parents[1]


class ConfigError(Exception):
    """What is wrong with an input, in one line, and where."""


class TomlFile:
    """A parsed TOML file that can say where a key stands.

    Parameters
    ----------
    path : Path
        The file; a message names it as it was given.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            self.text = path.read_text(encoding="utf-8")
        except OSError as error:
            raise ConfigError(f"{path}: cannot be read: {error.strerror}; check the path") from error
        except UnicodeDecodeError as error:
            raise ConfigError(f"{path}: is not UTF-8 text (byte {error.start})") from error
        try:
            self.data: dict[str, Any] = tomllib.loads(self.text)
        except tomllib.TOMLDecodeError as error:
            raise ConfigError(f"{path}: not valid TOML: {error}") from error

    def line_of(self, key: str, item: int = 0) -> int | None:
        """Line of a dotted key, or None where the text does not show it.

        Parameters
        ----------
        key : str
            Sections and key joined by dots.
        item : int
            Which one, for keys in a list of tables, from 0.
        """
        section = ""
        seen: dict[str, int] = {}
        for number, line in enumerate(self.text.splitlines(), start=1):
            stripped = line.strip()
            header = re.match(r"\[+\s*([^\]]+?)\s*\]+", stripped)
            if header:
                section = header.group(1).replace('"', "") + "."
                seen[section] = seen.get(section, -1) + 1
                if section == key + "." and seen[section] == item:
                    return number
                continue
            name = stripped.split("=", 1)[0].strip().replace('"', "")
            if seen.get(section, 0) != item:
                continue
            if "=" in stripped and (section + name == key or key.startswith(section + name + ".")):
                return number
        return None

    def error(self, key: str, what: str, item: int = 0) -> ConfigError:
        """Make the error that says what is wrong with a key.

        Parameters
        ----------
        key : str
            The dotted key.
        what : str
            What is wrong, with the range where there is one.
        item : int
            Which one, for keys in a list of tables, from 0.
        """
        line = self.line_of(key, item)
        where = f"{self.path}:{line}" if line else str(self.path)
        return ConfigError(f"{where}: {key}: {what}")

    def number(self, key: str, value: Any, low: float, high: float, item: int = 0) -> float:
        """Check that a value is a number in a range.

        Parameters
        ----------
        key : str
            The dotted key, for the message.
        value : Any
            What the file has there.
        low, high : float
            Both allowed.
        item : int
            Which one, for keys in a list of tables, from 0.
        """
        if isinstance(value, bool) or not isinstance(value, int | float):
            raise self.error(key, f"a number from {low:g} to {high:g} is needed, not {value!r}", item)
        if not low <= float(value) <= high:
            raise self.error(key, f"{value:g} is outside {low:g} to {high:g}", item)
        return float(value)


def flatten(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and values of nested tables; arrays stay whole."""
    for key, value in tree.items():
        if isinstance(value, dict):
            yield from flatten(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value
