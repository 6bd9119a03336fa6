"""Check control/ and ecu/ against MISRA C:2012 by cppcheck's addon and compare with the findings that are known.

A finding is a line that breaks a rule. They are counted per rule, file and function, so that an edit elsewhere in
the file does not stir them. Each rule
that occurs has a row with a reason in docs/misra.md.

Example: .venv/bin/python tools/misra.py              compare, exit 1 when something differs
         .venv/bin/python tools/misra.py --update     write the findings and the counts in docs/misra.md
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
FINDINGS_PATH = Path("tests/rules/misra_findings.txt")
DOCUMENT_PATH = Path("docs/misra.md")
FOLDERS = ("firmware/control", "firmware/ecu")
SCALARS = ("fixed", "float")
GENERATED = "can_protocol/generated"
# Rules on what nobody uses: a finding only when it is one for every number type.
UNUSED_RULES = ("2.3", "2.4", "2.5")
LIMIT_S = 100

Place = tuple[str, str, str]  # rule, file, function
Findings = dict[Place, dict[str, int]]  # count by number type


class MisraError(Exception):
    """The check could not be made."""


@dataclass(frozen=True)
class Deviation:
    """A row of the table in docs/misra.md."""

    category: str
    counts: str
    reason: str


# ---- running cppcheck ----------------------------------------------------------------------------


def cppcheck_version() -> str:
    """Release of cppcheck, as 2.10."""
    if shutil.which("cppcheck") is None:
        raise MisraError("cppcheck is not installed: sudo apt-get install cppcheck")
    said = subprocess.run(["cppcheck", "--version"], capture_output=True, text=True, timeout=LIMIT_S, check=True).stdout
    found = re.search(r"\d+\.\d+", said)
    if not found:
        raise MisraError(f"cppcheck does not say its version: {said!r}")
    return found.group()


def _addon(folder: Path) -> str:
    """The addon's settings, with a text of its own for each rule.

    Without, all findings have one text, and cppcheck then reports only the first on each line.
    """
    rules = [f"{chapter}.{number}" for chapter in range(1, 23) for number in range(1, 26)]
    texts = [f"Rule {rule} Required\nViolates {rule}" for rule in rules]
    text_path, addon_path = folder / "texts.txt", folder / "misra.json"
    text_path.write_text("\n".join(["Appendix A Summary of guidelines", *texts]) + "\n", "utf-8")
    addon_path.write_text(json.dumps({"script": "misra.py", "args": [f"--rule-texts={text_path}"]}), "utf-8")
    return str(addon_path)


def _raw_findings(root: Path, scalar: str, sources: Sequence[str], jobs: int) -> set[tuple[str, str, int]]:
    """(rule, file, line) of everything cppcheck reports; `sources` as paths from `root`."""
    arguments = [
        "cppcheck",
        "--quiet",
        f"-j{jobs}",
        f"--addon={_addon(root)}",
        "--enable=warning,style,portability",
        "--std=c11",
        "--platform=unix32",
        "-Ifirmware",
        "-I.",
        f"-DDIARC_SCALAR_{scalar.upper()}=1",
        f"--suppress=*:{GENERATED}/*",
        "--template={id}\t{file}\t{line}\t{message}",
        "--template-location=",
        *sources,
    ]
    try:
        result = subprocess.run(arguments, cwd=root, capture_output=True, text=True, timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired as error:
        raise MisraError(f"cppcheck took more than {LIMIT_S} s") from error
    if result.returncode != 0:
        raise MisraError(f"cppcheck failed: {result.stdout}{result.stderr}")
    findings = set()
    for line in result.stderr.splitlines():
        fields = line.split("\t", 3)
        if len(fields) < 4:
            raise MisraError(f"cppcheck said: {line}")
        name, file, number, message = fields
        if name in ("internalError", "syntaxError", "preprocessorErrorDirective", "cppcheckError"):
            raise MisraError(f"{file}:{number}: {message}")
        rule = name.removeprefix("misra-c2012-") if name.startswith("misra-") else f"cppcheck:{name}"
        findings.add((rule, file, int(number)))
    return findings


def check(root: Path = ROOT, sources: Sequence[str] = FOLDERS) -> Findings:
    """Findings in `sources`, paths from `root`, for each number type.

    cppcheck works on copies, one for each run, because it puts files beside those it reads.
    """
    cppcheck_version()
    jobs = max(1, (os.cpu_count() or 1) // len(SCALARS))
    with tempfile.TemporaryDirectory() as folder:
        copies = [Path(folder) / scalar for scalar in SCALARS]
        for copy in copies:
            for part in (*FOLDERS, GENERATED):
                shutil.copytree(root / part, copy / part)
        with ThreadPoolExecutor(len(SCALARS)) as pool:
            raw = list(pool.map(lambda copy: _raw_findings(copy, copy.name, sources, jobs), copies))
        owners = {
            file: line_owners((copies[0] / file).read_text("utf-8"))
            for file in {f[1] for findings in raw for f in findings}
        }
    everywhere = set.intersection(*raw)
    counts: dict[Place, Counter[str]] = {}
    for scalar, findings in zip(SCALARS, raw, strict=True):
        for finding in findings:
            rule, file, line = finding
            if rule not in UNUSED_RULES or finding in everywhere:
                counts.setdefault((rule, file, owners[file][line - 1]), Counter())[scalar] += 1
    return {place: dict(counter) for place, counter in counts.items()}


# ---- from lines to functions ---------------------------------------------------------------------

_COMMENT_OR_TEXT = re.compile(r'/\*.*?\*/|//[^\n]*|"(?:\\.|[^"\\\n])*"|\'(?:\\.|[^\'\\\n])*\'', re.DOTALL)


def _without_comments(text: str) -> str:
    """C without comments, lines kept."""
    return _COMMENT_OR_TEXT.sub(lambda m: re.sub(r"[^\n]", " ", m[0]) if m[0][0] == "/" else m[0], text)


def _name_of(item: str) -> str:
    """Name of one declaration, definition or directive at file scope."""
    directive = re.match(r'\s*#\s*(\w+)\s*(?:["<]([^">]+)[">]|(\w+))?', item)
    if directive:
        return directive[2] or directive[3] or "#" + directive[1]
    head = item.split("{")[0]
    if "=" not in head and (function := re.search(r"(\w+)\s*\(", head)):
        return function[1]
    if tag := re.match(r"\s*(?:typedef\s+)?(?:struct|enum|union)\s+(\w+)\s*$", head):
        return tag[1]
    if typedef := re.search(r"(\w+)\s*;\s*$", item):
        return typedef[1]
    variable = re.search(r"(\w+)\s*(?:\[[^=]*)?(?:=|;|$)", head)
    return variable[1] if variable else "-"


def line_owners(text: str) -> list[str]:
    """The function, type, variable or macro that each line of a C file belongs to; - for none."""
    owners: list[str] = []
    item: list[str] = []
    depth = 0
    for line in _without_comments(text).splitlines():
        if not item and not line.strip():
            owners.append("-")
            continue
        item.append(line)
        depth += line.count("{") - line.count("}")
        whole = "\n".join(item)
        if whole.lstrip().startswith("#"):
            ended = not line.rstrip().endswith("\\")
        else:
            is_function = "{" in whole and "=" not in whole.split("{")[0] and "(" in whole.split("{")[0]
            ended = depth == 0 and line.rstrip().endswith(("}", ";") if is_function else ";")
        if ended:
            owners += [_name_of(whole)] * len(item)
            item, depth = [], 0
    return owners + ["-"] * len(item)


# ---- the committed findings ----------------------------------------------------------------------


def rule_key(rule: str) -> tuple:
    """Sorts 9.3 before 10.1, and cppcheck's own checks last."""
    parts = rule.split(".")
    return (0, *map(int, parts)) if all(part.isdigit() for part in parts) else (1, rule)


def _lines(findings: Findings) -> list[str]:
    lines = []
    for (rule, file, function), counts in sorted(findings.items(), key=lambda f: (rule_key(f[0][0]), f[0][1:])):
        by_type = " ".join(f"{scalar}={counts[scalar]}" for scalar in SCALARS if scalar in counts)
        lines.append(f"{rule} {file} {function} {by_type}")
    return lines


def findings_text(findings: Findings, version: str) -> str:
    """The committed file."""
    head = [
        f"# cppcheck {version}",
        "# Made by `make rules`: rule, file, function, findings for each number type. Reasons: docs/misra.md.",
    ]
    return "\n".join([*head, *_lines(findings)]) + "\n"


def known_version(text: str) -> str:
    """Release of cppcheck that made the committed file."""
    return text.splitlines()[0].removeprefix("# cppcheck ").strip() if text else ""


def _by_place(lines: Iterable[str]) -> dict[str, str]:
    """Counts by rule, file and function, of the committed file's lines."""
    fields = [line.split(" ", 3) for line in lines if line and not line.startswith("#")]
    return {" ".join(field[:3]): field[3] for field in fields}


def compare(findings: Findings, text: str) -> list[str]:
    """What differs between `findings` and the committed file's text."""
    now, known = _by_place(_lines(findings)), _by_place(text.splitlines())
    complaints = [f"new: {place} {counts}" for place, counts in now.items() if place not in known]
    complaints += [f"gone: {place} {counts}" for place, counts in known.items() if place not in now]
    complaints += [
        f"changed: {place} {counts}, was {known[place]}"
        for place, counts in now.items()
        if known.get(place, counts) != counts
    ]
    return complaints


# ---- the document --------------------------------------------------------------------------------

_ROW = re.compile(r"^\| *((?:\d+\.\d+|cppcheck:\w+)) *\|([^|]*)\|([^|]*)\|(.*)\|$", re.MULTILINE)


def totals(findings: Findings) -> dict[str, str]:
    """Number of findings of each rule, as in the document: fixed / float."""
    sums: dict[str, Counter[str]] = {}
    for (rule, _, _), counts in findings.items():
        sums.setdefault(rule, Counter()).update(counts)
    return {rule: " / ".join(str(sums[rule][scalar]) for scalar in SCALARS) for rule in sorted(sums, key=rule_key)}


def deviations(document: str) -> dict[str, Deviation]:
    """The rows of the document's table by rule."""
    return {m[1]: Deviation(m[2].strip(), m[3].strip(), m[4].strip()) for m in _ROW.finditer(document)}


def undocumented(findings: Findings, document: str) -> list[str]:
    """Where the document and `findings` contradict each other."""
    rows = deviations(document)
    sums = totals(findings)
    complaints = [f"rule {rule} occurs and has no row in {DOCUMENT_PATH}" for rule in sums if rule not in rows]
    for rule, row in rows.items():
        if rule not in sums:
            complaints.append(f"rule {rule} has a row in {DOCUMENT_PATH} and does not occur")
        elif not row.reason or row.category not in ("required", "advisory", "-"):
            complaints.append(
                f"rule {rule} has no reason in {DOCUMENT_PATH}, or a category that cannot be deviated from"
            )
        elif row.counts != sums[rule]:
            complaints.append(f"rule {rule} occurs {sums[rule]} times; {DOCUMENT_PATH} says {row.counts}")
    return complaints


def with_totals(findings: Findings, document: str) -> str:
    """The document with today's counts."""
    sums = totals(findings)
    return _ROW.sub(lambda m: f"| {m[1]} |{m[2]}| {sums.get(m[1], '0 / 0')} |{m[4]}|", document)


def main() -> int:
    """Run from the command line; 0 when all is as it was, or was written."""
    parser = argparse.ArgumentParser(description="MISRA C:2012 findings of control/ and ecu/, against those known.")
    parser.add_argument("--update", action="store_true", help="write the findings and the counts in docs/misra.md")
    update = parser.parse_args().update
    try:
        version, findings = cppcheck_version(), check()
    except MisraError as error:
        print(f"misra: {error}", file=sys.stderr)
        return 1
    path, document_path = ROOT / FINDINGS_PATH, ROOT / DOCUMENT_PATH
    known = path.read_text("utf-8") if path.exists() else ""
    document = document_path.read_text("utf-8")
    complaints = compare(findings, known)
    if update:
        path.write_text(findings_text(findings, version), "utf-8")
        document = with_totals(findings, document)
        document_path.write_text(document, "utf-8")
        print("\n".join(complaints) or "nothing new")
        complaints = []
    complaints += undocumented(findings, document)
    print("\n".join(complaints), end="\n" if complaints else "")
    return int(bool(complaints))


if __name__ == "__main__":
    sys.exit(main())
