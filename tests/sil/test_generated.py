"""The generated files: what would let the C code and the DBC drift apart."""

from __future__ import annotations

import importlib.util
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path
from types import ModuleType

import pytest

from sil_plant.bus import protocol
from sil_plant.config import tomllib
from sil_plant.inputs.machine import load_parameter_table

ROOT = Path(__file__).resolve().parents[2]
DATE = re.compile(r"\b(19|20)\d\d\b.*\d\d:\d\d|\d\d:\d\d:\d\d|\b(19|20)\d\d-\d\d-\d\d\b")


@pytest.fixture(scope="module")
def generator() -> ModuleType:
    path = list(sys.path)
    spec = importlib.util.spec_from_file_location("generate", ROOT / "tools" / "generate.py")
    assert spec and spec.loader
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    sys.path[:] = path
    return module


@pytest.fixture(scope="module")
def generated(generator: ModuleType) -> dict[Path, str]:
    return generator.generate()


def test_committed_files_are_not_stale(generated: dict[Path, str]) -> None:
    """GIVEN the DBC, the parameter list and the reference arm WHEN all is generated anew
    THEN it is what is there.
    """
    stale = [str(path) for path, text in generated.items() if (ROOT / path).read_text("utf-8") != text]
    assert stale == [], "run `make generate` and commit the result"


def test_no_orphan_lies_among_the_generated_files(generated: dict[Path, str]) -> None:
    """GIVEN the folders of generated files WHEN listed THEN each file in them is one that is generated."""
    folders = {path.parent for path in generated if path.parent.name == "generated"}
    there = {path.relative_to(ROOT) for folder in folders for path in (ROOT / folder).iterdir()}
    assert there == {path for path in generated if path.parent in folders}


def test_dbc_does_not_name_faults_otherwise_than_their_table() -> None:
    """GIVEN faults.toml WHEN compared with the value lists of FaultCode THEN the same codes and names."""
    table = tomllib.loads((ROOT / "can_protocol" / "faults.toml").read_text("utf-8"))["fault"]
    expected = {0: "NONE"} | {fault["code"]: fault["name"] for fault in table}
    for frame in ("EMCY_ECU", "TIMING"):
        signal = protocol.database().get_message_by_name(frame).get_signal_by_name("FaultCode")
        assert {code: str(name) for code, name in signal.choices.items()} == expected


def test_faults_name_no_limit_that_is_no_parameter() -> None:
    """GIVEN the limits in faults.toml WHEN looked up THEN each is a parameter of the machine, or an object."""
    names = {entry.name.replace("swing", "*").replace("wrist", "*") for entry in load_parameter_table().entries}
    table = tomllib.loads((ROOT / "can_protocol" / "faults.toml").read_text("utf-8"))["fault"]
    limits = [limit.strip() for fault in table for limit in fault["limit"].split(",") if limit]
    assert limits
    for limit in limits:
        assert limit in names or limit.startswith("object "), limit


# ---- docs/protocol.md ----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def protocol_page(generated: dict[Path, str]) -> str:
    return generated[Path("docs/protocol.md")]


def section_of(page: str, frame: str) -> str:
    """What the page says of one frame."""
    return re.split(r"\n##+ ", page.split(f"\n### {frame}, ")[1])[0]


def test_drawing_does_not_place_a_signal_where_no_other_tool_looks(protocol_page: str) -> None:
    """GIVEN each signal of the DBC WHEN its bits alone are set by cantools
    THEN they stand where the page has its letter, in the drawing of its page.
    """
    for message in protocol.database().messages:
        section = section_of(protocol_page, message.name)
        drawings = re.findall(r"^      ([a-z. ]+?)(?:   (\w+) ([\d to and]+))?$", section, re.MULTILINE)
        for signal in message.signals:
            row = re.search(rf"^\| (\w) \| {signal.name}(?: \(page (\d+)\))? \|", section, re.MULTILINE)
            assert row, f"{message.name}.{signal.name} is not on the page"
            page = int(row[2]) if row[2] else None
            raw = dict.fromkeys((s.name for s in message.signals), 0)
            raw[signal.name] = -1 if signal.is_signed else (1 << signal.length) - 1
            if page is not None:
                raw[next(s.name for s in message.signals if s.is_multiplexer)] = page
            if signal.is_multiplexer:  # not every number is a page: from its place alone
                data = (raw[signal.name] << signal.start).to_bytes(8, "little")
            else:
                data = message.encode(raw, scaling=False, strict=False)
                cleared = message.encode(raw | {signal.name: 0}, scaling=False, strict=False)
                data = bytes(a ^ b for a, b in zip(data, cleared, strict=True))
            for drawn, _, span in drawings:
                numbers = [int(n) for n in re.findall(r"\d+", span)]
                there = page is None or page in numbers or (" to " in span and numbers[0] <= page <= numbers[1])
                if there:
                    bits = "".join("1" if c == row[1] else "0" for c in drawn.replace(" ", ""))
                    assert int(bits, 2).to_bytes(message.length, "big") == data, f"{message.name}.{signal.name}"


def test_crc_on_the_page_does_not_give_what_nobody_accepts(protocol_page: str, tmp_path: Path) -> None:
    """GIVEN the C of the page, compiled WHEN given its golden vector and whole frames THEN byte 0 of each."""
    compiler = shutil.which("cc")
    assert compiler, "cc is not installed: sudo apt-get install gcc"
    code = re.search(r"```c\n(.*?)```", protocol_page, re.DOTALL)
    golden = re.search(r"identifier (\w+)h.*?\*\*((?:\w\w ?){8})\*\*", protocol_page, re.DOTALL)
    assert code and golden
    frames = re.findall(r"^\| \w+ \| (\w+)h \| `((?:\w\w ?){8})` \|", protocol_page, re.MULTILINE)
    assert len(frames) >= 3
    checks = ""
    for can_id, data in [golden.groups(), *frames]:
        octets = ", ".join(f"0x{byte}" for byte in data.split())
        checks += f"    wrong += e2e_crc(0x{can_id}, (const uint8_t[8]){{{octets}}}) != 0x{data.split()[0]};\n"
    source, program = tmp_path / "crc.c", tmp_path / "crc"
    source.write_text(
        f"#include <stdint.h>\n{code[1]}\nint main(void)\n{{\n    int wrong = 0;\n{checks}    return wrong;\n}}\n",
        "utf-8",
    )
    command = [compiler, "-std=c11", "-Wall", "-Wextra", "-Werror", str(source), "-o", str(program)]
    assert subprocess.run(command, timeout=60, check=False).returncode == 0
    assert subprocess.run([str(program)], timeout=10, check=False).returncode == 0


def test_bus_load_on_the_page_is_not_another_than_the_plants(protocol_page: str) -> None:
    """GIVEN the tick of 1 ms WHEN looked up THEN the load that run.py tells; at 0.5 ms it does not fit."""
    assert f"| 1 ms | {100 * protocol.worst_case_bus_load():.0f} % |" in protocol_page
    assert re.search(r"^\| 0\.5 ms \| 1\d\d %: does not fit \|$", protocol_page, re.MULTILINE)


def test_links_of_the_page_lead_somewhere(protocol_page: str) -> None:
    """GIVEN every link of the page WHEN followed THEN file and heading are there."""
    links = re.findall(r"\]\(([^)\s]+)\)", protocol_page)
    assert {"objects.md", "faults.md", "modes.md"} <= {link.split("#")[0] for link in links}
    for link in links:
        name, _, anchor = link.partition("#")
        target = (ROOT / "docs" / name).resolve() if name else ROOT / "docs" / "protocol.md"
        assert target.exists(), link
        if anchor:
            headings = re.findall(r"^#+ (.*)$", target.read_text("utf-8"), re.MULTILINE)
            assert anchor in {re.sub(r"[^a-z0-9_ -]", "", h.lower()).replace(" ", "-") for h in headings}, link


def test_check_does_not_pass_a_stale_or_missing_file(
    generator: ModuleType,
    generated: dict[Path, str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """GIVEN one changed and one missing file WHEN checked
    THEN status 1, both named, `make generate` named.
    """
    for path in generated:
        (tmp_path / path).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / path, tmp_path / path)
    monkeypatch.setattr(generator, "ROOT", tmp_path)
    monkeypatch.setattr(generator, "generate", lambda: generated)
    monkeypatch.setattr(sys, "argv", ["generate.py", "--check"])
    assert generator.main() == 0
    changed, missing = sorted(generated)[:2]
    (tmp_path / changed).write_text((tmp_path / changed).read_text("utf-8") + " ", "utf-8")
    (tmp_path / missing).unlink()
    capsys.readouterr()
    assert generator.main() == 1
    said = capsys.readouterr().out
    assert f"stale: {changed}" in said and f"stale: {missing}" in said and "make generate" in said


def test_date_line_does_not_make_every_day_a_change(
    generator: ModuleType, generated: dict[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """GIVEN another day WHEN generated anew THEN every byte is the same, and no line holds a date."""
    asked = []
    monkeypatch.setattr(time, "ctime", lambda *_: asked.append(1) or "Thu Feb 29 12:34:56 2052")
    assert generator.cantools_sources() == {k: generated[k] for k in generator.cantools_sources()}
    assert asked, "cantools takes its date from somewhere else now: this test no longer tests anything"
    dated = [f"{path}: {line}" for path, text in generated.items() for line in text.splitlines() if DATE.search(line)]
    assert dated == []
    assert any("generated by cantools version" in text for text in generated.values())


def test_built_in_arm_is_not_another_than_the_machine_file(simulate) -> None:
    """GIVEN the firmware's built-in image WHEN it runs THEN its trace is that of the reference arm's file."""
    built_in = simulate(duration=0.5, built_in=True).result
    assert built_in.trace_sha256 == simulate(duration=0.5).result.trace_sha256
