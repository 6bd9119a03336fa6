"""Fill in what a machine file lacks, and leave what its author wrote as it is."""

from __future__ import annotations

import re
from collections import defaultdict

from sil_plant.config import flatten, tomllib
from sil_plant.design.proposal import Proposal, as_toml, number
from sil_plant.inputs.machine_keys import MachineKeys

FILLED_IN = "# proposed by tools/check_arm.py"


def complete_text(keys: MachineKeys, missing: dict[str, Proposal]) -> tuple[str, bool]:
    """The text of a machine file with values for missing keys, and whether its comments were kept.

    Keys of a section that is there are put below its header, other sections at the end. A file that says its
    sections in another way (dotted keys, inline tables) is written anew.

    Parameters
    ----------
    keys : MachineKeys
        A file without errors but missing keys.
    missing : dict
        What to fill in.
    """
    if keys.toml is None:
        raise ValueError("a file that is no TOML cannot be completed")
    lines = keys.toml.text.splitlines()
    by_section: dict[str, dict[str, Proposal]] = defaultdict(dict)
    for key, proposal in missing.items():
        by_section[key.rsplit(".", 1)[0]][key] = proposal
    new: dict[str, Proposal] = {}
    for section, proposals in by_section.items():
        header = next((n for n, line in enumerate(lines) if _header(line) == section), None)
        if header is None:
            new |= proposals
        else:
            body = as_toml(proposals).splitlines()[1:]
            lines[header + 1 : header + 1] = [FILLED_IN, *body]
    if new:
        lines += ["", FILLED_IN.replace("proposed", "Proposed") + ": formulas and measured quality in docs/tutorial.md"]
        lines += as_toml(new).splitlines()
    text = "\n".join(lines) + "\n"
    wanted = dict(flatten(keys.toml.data)) | {key: p.value for key, p in missing.items()}
    try:
        found = dict(flatten(tomllib.loads(text)))
    except tomllib.TOMLDecodeError:
        found = {}
    if all(key in found and _same(found[key], value) for key, value in wanted.items()):
        return text, True
    return _anew(wanted), False


def _header(line: str) -> str:
    match = re.match(r"\s*\[\s*([^\[\]]+?)\s*\]", line)
    return match.group(1).replace('"', "").replace(" ", "") if match else ""


def _same(found: object, wanted: object) -> bool:
    if isinstance(found, int | float) and isinstance(wanted, int | float):
        return abs(found - wanted) <= 1e-5 * abs(wanted)
    return found == wanted


def _anew(values: dict[str, object]) -> str:
    """Every value in sections; shorter sections' names first, as a TOML file has to have them."""
    sections: dict[str, list[str]] = defaultdict(list)
    for key, value in values.items():
        section, _, name = key.rpartition(".")
        text = repr(value) if isinstance(value, float) else number(value) if isinstance(value, int) else f'"{value}"'
        sections[section].append(f"{name} = {text}")
    parts = ["\n".join(sections.pop("", []))]
    parts += [f"[{section}]\n" + "\n".join(body) for section, body in sections.items()]
    return "\n\n".join(part for part in parts if part) + "\n"
