"""What a run has found so far, kept beside its result, so that a killed one need not begin anew.

A stage is kept as records (`graphslam.core.record_codec`) in a folder beside the target, under a
key of everything that a result depends on: contents and paths of the logs, settings, versions and
source of this program and its libraries. A run of another key does not use it. As every stage is
repeatable, what follows from a kept one is what would have followed without the interruption.
"""

import hashlib
import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import is_dataclass
from functools import cache, partial
from importlib import import_module
from importlib.metadata import version
from pathlib import Path
from platform import python_version
from typing import Any, BinaryIO, TypeVar

from graphslam.core.config import Config
from graphslam.core.config_io import dump_config
from graphslam.core.errors import OutputError
from graphslam.core.record_codec import CodecError, Kinds, read, write
from graphslam.core.source_digest import source_digest
from graphslam.core.stages import announce
from graphslam.logs import LogSet
from graphslam.mapping.known_map import KnownMap
from graphslam.pipeline.log_pass import LogPass

_T = TypeVar("_T")

FORMAT = "graphslam-checkpoint-1"
#: s: a run that was not asked for it keeps stages from then on
LONG_S = 30.0
LIBRARIES = ("gtsam", "numpy", "opencv-python-headless", "scipy")

#: modules all of whose dataclasses and named tuples may be kept, and classes of others
_MODULES = (
    "core.config", "core.information_root", "core.known_landmarks", "core.motion_models",
    "core.mount_covariances", "core.observation_arrays", "core.records", "core.sensor_config",
    "core.sparse_gaussian", "estimation.clock_calibration", "logs.clock", "logs.log_set",
    "mapping.landmark_map", "multi_robot.frame_tree", "multi_robot.relative_frames",
    "odometry.increment_sums", "odometry.interpolation", "odometry.missing_increments",
    "pipeline.recorded_closures", "pipeline.repeated_scans", "pipeline.robot_state",
    "pipeline.scans_between", "pipeline.scans_since_keyframe", "scan_smoothing.scan_tracking",
)  # fmt: skip
_CLASSES = (
    ("mapping.landmark_map", "LandmarkMap"),
    ("odometry.contradicted_motions", "ContradictedMotions"),
    ("odometry.increment_sums", "IncrementSums"),
    ("odometry.increment_sums", "PathSums"),
    ("odometry.online_calibration", "Calibrator"),
    ("odometry.online_calibration", "Learnt"),
    ("odometry.online_noise", "NoiseEvidence"),
    ("odometry.preintegration", "Track"),
    ("odometry.several_lasers", "SeveralLasersTrack"),
    ("odometry.sudden_changes", "SuddenChange"),
    ("pipeline.log_pass", "PriorKnowledge"),
)
#: of a pass: what is given to it, or works only while the log is read; all else is kept
_MADE_ANEW = frozenset({
    "_checker", "_path", "_tracker", "associator", "backend", "candidates", "config", "frames",
    "front_end", "given_config", "groups", "keyframes", "known", "log", "robot_detector",
    "scan_buffer", "skipped_before", "tamper",
})  # fmt: skip


@cache
def kinds() -> Kinds:
    """The classes that are kept. The latest scan of a robot is not: it is for the next one."""
    found = [getattr(import_module(f"graphslam.{module}"), name) for module, name in _CLASSES]
    for name in _MODULES:
        module = import_module(f"graphslam.{name}")
        found += [
            kind
            for kind in vars(module).values()
            if isinstance(kind, type)
            and kind.__module__ == module.__name__
            and (is_dataclass(kind) or issubclass(kind, tuple))
        ]
    robot_state = import_module("graphslam.pipeline.robot_state").RobotState
    return Kinds(found, {robot_state: frozenset({"scan"})})


class Checkpoint:
    """The stages of one run, kept or not; `stage` and `read_pass` are given the work of each.

    ``resumed``: stages that were taken from disk.
    """

    def __init__(
        self, folder: Path | None = None, key: Callable[[], str] = str, *, asked: bool = False
    ) -> None:
        """Without a folder nothing is kept. ``asked``: from the first stage on, however short.

        ``key`` takes as long as reading the source of this program, and is called when needed.
        """
        self._folder, self._make_key, self._key = folder, key, ""
        self._began = time.monotonic()
        self._lock: BinaryIO | None = None
        self._passes = 0
        self.resumed: list[str] = []
        if asked:
            self._open()

    def stage(self, name: str, make: Callable[[], _T]) -> _T:
        """What ``make`` gives, or what it gave to an earlier run."""
        found = self._find(name)
        if found is not None:
            made: _T = found[0]
            return made
        made = make()
        self._keep(name, lambda: made)
        return made

    def read_pass(self, one: LogPass, run: Callable[[], _T]) -> _T:
        """A pass over the log by ``run``, after which ``one`` has what it found."""
        self._passes += 1
        name = f"pass {self._passes}"
        found = self._find(name)
        if found is not None:
            result, report, one.skipped_before, state = found
            for attribute, value in state.items():
                setattr(one, attribute, value)
            one.log.update(report)
            return result  # type: ignore[no-any-return]
        result = run()
        self._keep(name, lambda: (result, one.log.report(), dict(one.skipped), _state(one)))
        return result

    def _find(self, name: str) -> tuple[Any, ...] | None:
        if self._lock is None or self._folder is None:
            return None
        try:
            data = (self._folder / _file_name(name)).read_bytes()
            body, digest = data[:-32], data[-32:]
            if hashlib.sha256(body).digest() != digest:
                return None
            key, value = read(body, kinds())
        except (OSError, CodecError):
            return None
        if key != self._key:
            return None
        self.resumed.append(name)
        announce(f"{name}: of the run before")
        return value if name.startswith("pass") else (value,)

    def _keep(self, name: str, value: Callable[[], Any]) -> None:
        """Write a stage; what cannot be written is not kept, and the run goes on."""
        if self._folder is None:
            return
        if self._lock is None and time.monotonic() - self._began > LONG_S:
            with suppress(OutputError):
                self._open()
        if self._lock is None:
            return
        announce("checkpoint")
        part = self._folder / "part"
        try:
            with part.open("wb") as stream:
                hashed = _Hashed(stream)
                write((self._key, value()), kinds(), hashed)
                stream.write(hashed.digest())
            part.rename(self._folder / _file_name(name))
        except (OSError, TypeError):
            part.unlink(missing_ok=True)

    def _open(self) -> None:
        """Make the folder, or take over that of a dead process; it is locked until `close`.

        Raises:
            OutputError: another process is at work there, or the disk refuses.
        """
        assert self._folder is not None
        try:
            self._folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            found = self._folder.stat(follow_symlinks=False)
            if self._folder.is_symlink() or found.st_uid != os.geteuid():
                raise OutputError(f"{self._folder}: is not of this user; remove it")
            self._lock = _locked(self._folder / "lock")
        except OSError as error:
            raise OutputError(f"{self._folder}: cannot be written: {error.strerror}") from error
        if self._lock is None:
            raise OutputError(
                f"{self._folder}: another process is at work on this result; wait for it, or "
                "choose another name"
            )
        self._key = self._make_key()

    def close(self, *, remove: bool) -> None:
        """Let others have the folder, or ``remove`` it."""
        if self._lock is None or self._folder is None:
            return
        if remove:
            shutil.rmtree(self._folder, ignore_errors=True)
        self._lock.close()
        self._lock = None


class _Hashed:
    """A stream to write to, and the digest of what was written."""

    def __init__(self, stream: BinaryIO) -> None:
        self._stream, self._hash = stream, hashlib.sha256()

    def write(self, data: bytes, /) -> int:
        self._hash.update(data)
        return self._stream.write(data)

    def digest(self) -> bytes:
        return self._hash.digest()


NOTHING_KEPT = Checkpoint()


def folder_of(target: Path) -> Path:
    """Where the stages of a result are kept."""
    final = target.absolute()
    return final.with_name(f".{final.name}.checkpoint")


@contextmanager
def checkpoint(
    target: str | os.PathLike[str] | None,
    log: LogSet,
    config: Config,
    known_map: KnownMap | None = None,
    *,
    resume: bool,
) -> Iterator[Checkpoint]:
    """The checkpoint of a run that writes ``target``; it is gone when the block ends well.

    If the block raises, it stays where ``resume`` asked for it. Without that, what a dead process
    left is removed.

    Raises:
        OutputError: ``resume``, and there is no target, another process is at work there, or the
            disk refuses.
    """
    if target is None:
        if resume:
            raise OutputError("resume: there is no output beside which anything could be kept")
        yield NOTHING_KEPT
        return
    folder = folder_of(Path(target))
    if not resume:
        remove_dead(folder)
    one = Checkpoint(folder, partial(key_of, log, config, known_map), asked=resume)
    done = False
    try:
        yield one
        done = True
    finally:
        one.close(remove=done or not resume)


def remove_dead(folder: Path) -> None:
    """Remove a folder that no process is at work in."""
    if not folder.is_dir() or folder.is_symlink():
        return
    with suppress(OSError):
        lock = _locked(folder / "lock")
        if lock is not None:
            shutil.rmtree(folder, ignore_errors=True)
            lock.close()


def key_of(log: LogSet, config: Config, known_map: KnownMap | None = None) -> str:
    """What a result depends on, in short."""
    told = [FORMAT, dump_config(config), python_version()]
    told += [f"{file.path.resolve()}\n{file.sha256}" for file in log.files]
    told += [f"{name} {version(name)}" for name in LIBRARIES]
    told.append(source_digest())
    told += [] if known_map is None else [known_map.sha256]
    digest = hashlib.sha256("\n".join(told).encode(errors="backslashreplace"))
    return digest.hexdigest()


def _state(one: LogPass) -> dict[str, Any]:
    return {name: value for name, value in vars(one).items() if name not in _MADE_ANEW}


def _file_name(stage: str) -> str:
    return f"{stage.replace(' ', '-')}.records"


def _locked(path: Path) -> BinaryIO | None:
    """The file, locked by this process alone, not its children; None: another one has it."""
    stream = path.open("ab")
    try:
        import fcntl  # noqa: PLC0415 (not on every system; there nothing is locked)

        fcntl.lockf(stream, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except ImportError:
        pass
    except OSError:
        stream.close()
        return None
    return stream
