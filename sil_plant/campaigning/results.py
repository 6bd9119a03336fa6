"""The folder of a campaign's results: Parquet shards, one per batch, each written whole or not at all."""

from __future__ import annotations

import fcntl
import json
import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import pyarrow as pa
import pyarrow.parquet as pq

from sil_plant.campaigning.arm_run import FIGURE_COLUMNS, SENSOR_NAMES, has_sensor_gains, sensor_column
from sil_plant.campaigning.sampling import Arm
from sil_plant.campaigning.spec import Campaign
from sil_plant.config import ConfigError

MANIFEST = "campaign.json"
LOCK = "campaign.lock"
SHARDS = "shards"
ALL_ROWS = "runs.parquet"
KEY = b"diarc_campaign"
UNFINISHED = ".part"


def schema(campaign: Campaign) -> pa.Schema:
    """The columns of the results."""
    columns = [
        ("run", pa.int64()),
        ("status", pa.string()),
        ("reason", pa.string()),
        ("seed", pa.int64()),
        ("commission_seed", pa.int64()),
    ]
    columns += [(variable.label, pa.float64()) for variable in campaign.variables]
    if has_sensor_gains({key for variable in campaign.variables for key in variable.keys}):
        columns += [(sensor_column(name), pa.float64()) for name in SENSOR_NAMES]
    columns += [(name, pa.float64()) for name in FIGURE_COLUMNS]
    columns += [
        ("faulted", pa.bool_()),
        ("faults", pa.string()),
        ("lost_frames", pa.int64()),
        ("ticks", pa.int64()),
        ("trace_sha256", pa.string()),
    ]
    return pa.schema(columns)


@dataclass(frozen=True)
class Batch:
    """Arms that are computed and written together."""

    number: int
    arms: tuple[Arm, ...]

    @property
    def name(self) -> str:
        """The runs in it, for messages."""
        first, last = self.arms[0].run, self.arms[-1].run
        return f"run {first}" if first == last else f"runs {first} to {last}"


def batches(arms: Sequence[Arm], size: int) -> list[Batch]:
    """The arms in batches; the last may be smaller. They do not depend on who computes them."""
    return [Batch(n, tuple(arms[first : first + size])) for n, first in enumerate(range(0, len(arms), size))]


class ResultFolder:
    """The folder of one campaign, held by one process at a time.

    Parameters
    ----------
    path : Path
        The folder; made when it is not there.
    campaign : Campaign
        The spec.
    code : str
        Hash of the code, :func:`sil_plant.campaigning.arm_run.code_hash`.
    """

    def __init__(self, path: Path, campaign: Campaign, code: str) -> None:
        self.path = path
        self.schema = schema(campaign)
        self.campaign = campaign
        self.code = code
        self.key = f"{campaign.spec_hash[:32]}-{code[:32]}"
        self._lock: IO[str] | None = None

    # ---- opening ----------------------------------------------------------------------------------

    def open(self, resume: bool, fresh: bool) -> None:
        """Take possession of the folder.

        Parameters
        ----------
        resume : bool
            Go on with what is there.
        fresh : bool
            Remove the results that are there first, whatever they are of.

        Raises
        ------
        ConfigError
            When the folder is in use, is no campaign's, or has results that are of something else or are not to be
            touched; says what to do.
        """
        try:
            self._take()
            manifest = self._manifest()
            if manifest is None and any(p.name != LOCK for p in self.path.iterdir()):
                raise ConfigError(f"{self.path}: is not empty, and no campaign's; choose another folder: --out FOLDER")
            if manifest is not None and fresh:
                self._remove()
                manifest = None
            if manifest is not None:
                self._check(manifest, resume)
            (self.path / SHARDS).mkdir(exist_ok=True)
            for part in self.path.rglob(f"*{UNFINISHED}"):
                part.unlink()
            if manifest is None:
                self._write_manifest()
        except OSError as error:
            raise _not_written(error.filename or self.path, error) from error

    def close(self) -> None:
        """Let others have the folder."""
        if self._lock is not None:
            self._lock.close()
            self._lock = None

    def _take(self) -> None:
        self.path.mkdir(parents=True, exist_ok=True)
        self._lock = (self.path / LOCK).open("w")
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            raise ConfigError(
                f"{self.path}: another campaign is writing there; wait for it, or --out FOLDER"
            ) from error

    def _manifest(self) -> dict[str, Any] | None:
        path = self.path / MANIFEST
        if not path.exists():
            return None
        try:
            manifest = json.loads(path.read_text(encoding="utf-8"))
            return {name: str(manifest[name]) for name in ("spec", "code", "key", "name")}
        except (ValueError, KeyError, TypeError) as error:
            raise ConfigError(f"{path}: is no campaign's; choose another folder: --out FOLDER") from error

    def _check(self, manifest: dict[str, Any], resume: bool) -> None:
        if manifest["key"] != self.key:
            spec_differs = manifest["spec"] != self.campaign.spec_hash
            what = (
                "another spec" if spec_differs else "other code (sources of the plant, the firmware, or numpy and so)"
            )
            raise ConfigError(
                f"{self.path}: has the results of {what}, campaign {manifest['name']}; give another folder with "
                "--out FOLDER, or remove those results with --fresh"
            )
        if not resume and any((self.path / SHARDS).glob("*.parquet")):
            raise ConfigError(
                f"{self.path}: has results of this very campaign; continue with --resume, or begin anew with --fresh"
            )

    def _remove(self) -> None:
        """Remove results; only files that a campaign writes."""
        for shard in (self.path / SHARDS).glob("*.parquet"):
            shard.unlink()
        for name in (ALL_ROWS, MANIFEST):
            (self.path / name).unlink(missing_ok=True)

    def _write_manifest(self) -> None:
        manifest = {
            "name": self.campaign.name,
            "spec_file": str(self.campaign.path),
            "spec": self.campaign.spec_hash,
            "code": self.code,
            "key": self.key,
        }
        write_whole(self.path / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())

    # ---- rows -------------------------------------------------------------------------------------

    def shard(self, batch: Batch) -> Path:
        """The file of a batch."""
        return self.path / SHARDS / f"{batch.number:06d}.parquet"

    def missing(self, wanted: Iterable[Batch]) -> tuple[list[Batch], list[Path]]:
        """The batches without a good shard, and shards that are damaged: they are computed again."""
        left, damaged = [], []
        for batch in wanted:
            path = self.shard(batch)
            if not path.exists():
                left.append(batch)
            elif not self._good(path, batch):
                left.append(batch)
                damaged.append(path)
        return left, damaged

    def _good(self, path: Path, batch: Batch) -> bool:
        try:
            table = pq.read_table(path, partitioning=None)
        except (pa.ArrowException, OSError):
            return False
        mine = (table.schema.metadata or {}).get(KEY) == self.key.encode()
        return mine and table["run"].to_pylist() == [arm.run for arm in batch.arms]

    def write(self, batch: Batch, rows: Sequence[dict[str, Any]]) -> None:
        """Write a batch, whole or not at all.

        Raises
        ------
        ConfigError
            When there is no room or no permission; what was written before is kept.
        """
        table = pa.Table.from_pylist(list(rows), self.schema.with_metadata({KEY: self.key.encode()}))
        try:
            write_whole(self.shard(batch), _parquet(table))
        except OSError as error:
            raise _not_written(self.shard(batch), error) from error

    def collect(self, wanted: Iterable[Batch]) -> pa.Table:
        """All rows that are there in order of run, also written to one file.

        Raises
        ------
        ConfigError
            When that file cannot be written.
        """
        there = [self.shard(batch) for batch in wanted if self.shard(batch).exists()]
        parts = [pq.read_table(path, partitioning=None) for path in there]
        table = pa.concat_tables(parts).combine_chunks() if parts else self.schema.empty_table()
        try:
            write_whole(self.path / ALL_ROWS, _parquet(table))
        except OSError as error:
            raise _not_written(self.path / ALL_ROWS, error) from error
        return table


def _parquet(table: pa.Table) -> bytes:
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd")
    return sink.getvalue().to_pybytes()


def write_whole(path: Path, data: bytes) -> None:
    """Write a file so that at every moment it is there whole or not at all, also when the power goes.

    Raises
    ------
    OSError
        When it cannot be written; nothing of it is left.
    """
    part = path.with_name(path.name + UNFINISHED)
    try:
        with part.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        with suppress(OSError):
            part.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)
    finally:
        os.close(folder)


def _not_written(path: Path | str, error: OSError) -> ConfigError:
    return ConfigError(
        f"{path}: cannot be written: {error.strerror or error}; make room or choose another --out. What was finished "
        "is kept: continue with --resume"
    )
