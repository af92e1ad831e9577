"""Live estimates: a recording that grows at ten times real time, and a soak.

`intel`: another process writes Intel ten times as fast as it was recorded, and `graphslam.follow`
estimates it. Two times per scan: what its messages take to work on (`Session` with messages at
hand), and from when the scan was written to its estimate, which includes that late messages are
waited for. The folder is written in a second process, as by the command. Relations are those of
causal poses.

`beginnings`: causal relations of Intel without its first 0, 20, 300, 600, 900 and 1200 s and of
ACES, live and by `smooth --causal`, with live's horizon and with the whole past: those of one log
differ by chance, as the first round decides. Relations tell how well a path agrees with itself: a
jump back to the truth counts as an error. So poses are compared with the final ones too.

`drifting`: ACES, as recorded and with two draws of noise on its odometry (`perturbed_logs.py`),
live, with loops closed by places and by landmarks alone.

`soak`: the five robots of `long_run.py` for two hours, as fast as it goes; memory of the process
after every tenth of the drive, and the share by which it grew in the last half.

Run: python benchmarks/live.py [intel] [beginnings] [drifting] [soak] [--minutes 120]
"""

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as the command line has it; read by NumPy

import multiprocessing
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import perturbed_logs
from common import FREIBURG, parser
from long_run import ROBOTS, record, true_poses
from mcap.reader import make_reader
from mcap.writer import Writer

import graphslam
from graphslam.core.config import LiveConfig
from graphslam.core.geometry import Array, between, compose, transform
from graphslam.core.records import Message, Scan, Trajectory
from graphslam.core.worker import allow_fork
from graphslam.evaluation.relation_metrics import read_relations
from graphslam.evaluation.trajectory_metrics import align
from graphslam.importers import IMPORTERS
from graphslam.results.folder import SavedRobot

#: how much faster than it was recorded
SPEED = 10.0
#: what `beginnings` runs: logs, and s that are left out at first
BEGINNINGS = {"intel": (0, 20, 300, 600, 900, 1200), "aces": (0,)}
#: s; from the start of the writer to its first message
HEAD_START_S = 3.0


def main() -> None:
    """Print what was asked for."""
    options = parser(__doc__)
    options.add_argument("which", nargs="*", default=("intel", "beginnings", "drifting", "soak"))
    options.add_argument("--minutes", type=int, default=120)
    chosen = options.parse_args()
    with tempfile.TemporaryDirectory() as name:
        if "intel" in chosen.which:
            print(intel(Path(name)))
        if "beginnings" in chosen.which:
            for line in beginnings(Path(name)):
                print(line, flush=True)
        if "drifting" in chosen.which:
            for line in drifting(Path(name)):
                print(line, flush=True)
        if "soak" in chosen.which:
            for line in soak(Path(name), chosen.minutes):
                print(line, flush=True)


def intel(folder: Path) -> str:
    """Times and errors of Intel as a session, and followed while it is written."""
    log = folder / "intel.mcap"
    IMPORTERS["carmen"](FREIBURG / "intel.clf.bz2", log)
    worked = work_ms(log)
    allow_fork()
    begin = time.monotonic() + HEAD_START_S
    recorder = multiprocessing.Process(target=write, args=(log, folder / "now.mcap", begin))
    recorder.start()
    due = {stamp: begin + seconds / SPEED for stamp, seconds in scan_times(log)}
    waited: list[float] = []
    told = graphslam.follow(
        folder / "now.mcap",
        folder / "now",
        each=lambda e: waited.append(1e3 * (time.monotonic() - due[e.stamp_ns])),
    )
    recorder.join()
    relations = read_relations(FREIBURG / "intel.relations")
    found = graphslam.evaluate(folder / "now", relations=relations)["relations"]
    errors = ", ".join(f"{k} {found[k]['trans_mean_m']:.4f} m" for k in ("all", "local", "loops"))
    return (
        f"work per scan, ms: {quantiles(worked)}\n"
        f"from written to estimated at {SPEED:g} x real time, ms: {quantiles(np.array(waited))}\n"
        f"{told['live']['estimates']} estimates, largest jump {told['live']['largest_jump_m']} m; "
        f"relations, causal: {errors}"
    )


def quantiles(values: Array) -> str:
    """Median, 99 %, 99.9 % and largest."""
    names = ("p50", "p99", "p99.9", "max")
    numbers = np.percentile(values, [50, 99, 99.9, 100])
    return ", ".join(f"{name} {x:.1f}" for name, x in zip(names, numbers, strict=True))


def work_ms(log: Path) -> Array:
    """Times (n,), ms, between two scans that a session takes, without reading the log."""
    messages = list(graphslam.open_logs(log).messages())
    scans, working = 0, 0.0
    found: list[float] = []
    began = time.perf_counter()

    def timed() -> Iterator[Message]:
        nonlocal began, working, scans
        for message in messages:
            working += time.perf_counter() - began
            if isinstance(message, Scan):
                found.append(1e3 * working)
                working = 0.0
            began = time.perf_counter()
            yield message

    for _ in graphslam.Session().process(timed()):
        pass
    return np.array(found)


def messages_of(log: Path) -> Iterator[tuple[str, str, bytes, int]]:
    """Topic, schema, data and log time, ns, in the order of the file."""
    with log.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages(log_time_order=False):
            assert schema is not None
            yield channel.topic, schema.name, message.data, message.log_time


def scan_times(log: Path) -> list[tuple[int, float]]:
    """The stamp of each scan, and when it was recorded, s since the first message."""
    first = next(messages_of(log))[3]
    found = []
    for _, schema, data, log_time in messages_of(log):
        if schema.endswith("LaserScan"):
            seconds, nanoseconds = np.frombuffer(data, dtype="<u4", count=2, offset=4).tolist()
            found.append((seconds * 1_000_000_000 + nanoseconds, 1e-9 * (log_time - first)))
    return found


def write(log: Path, target: Path, begin: float) -> None:
    """Write a log again, each message when it is due; ``begin``: of `time.monotonic`."""
    found = list(messages_of(log))
    first = found[0][3]
    with target.open("wb") as stream:
        writer = Writer(stream, use_chunking=False)
        writer.start()
        channels: dict[str, int] = {}
        for topic, schema, data, log_time in found:
            due = begin + 1e-9 * (log_time - first) / SPEED
            if due > time.monotonic():
                stream.flush()
                time.sleep(max(due - time.monotonic(), 0.0))
            add(writer, channels, topic, schema, log_time, data)
        writer.finish()


def add(
    writer: Writer, channels: dict[str, int], topic: str, schema: str, time_ns: int, data: bytes
) -> None:
    """Write a message; its topic is registered with the first one."""
    if topic not in channels:
        number = writer.register_schema(schema, "ros2msg", b"")
        channels[topic] = writer.register_channel(topic, "cdr", number)
    writer.add_message(channels[topic], time_ns, data, time_ns)


def beginnings(folder: Path) -> Iterator[str]:
    """Causal errors of each beginning of a log: live, and by `smooth --causal`.

    The latter with live's horizon (which live equals until a place closes a loop), and with the
    whole past.
    """
    rows = []
    for name, beginning in BEGINNINGS.items():
        whole, part = folder / f"{name}.mcap", folder / f"{name}-part.mcap"
        IMPORTERS["carmen"](FREIBURG / f"{name}.clf.bz2", whole)
        relations = read_relations(FREIBURG / f"{name}.relations")
        for seconds in beginning:
            write_from(whole, part, seconds)
            graphslam.follow(part, folder / "live", force=True)
            same = {"causal": True, "name": "isam2", "horizon_s": LiveConfig().horizon_s}
            for target, backend in (("horizon", same), ("whole", {"causal": True})):
                graphslam.smooth(part, output=folder / target, force=True, backend=backend)
            final = scans_of(folder / "whole").scan_final
            now = scans_of(folder / "live").scan_final
            found = [(now, graphslam.evaluate(folder / "live", relations=relations)["relations"])]
            for target in ("horizon", "whole"):
                judged = graphslam.evaluate(folder / target, relations=relations)["relations"]
                found.append((scans_of(folder / target).scan_causal, judged["causal"]))
            rows.append([
                (judged["all"]["trans_mean_m"], *off_final_m(path, final)) for path, judged in found
            ])  # fmt: skip
            yield f"{name} from {seconds} s on: {told(rows[-1])}"
    yield f"means: {told(np.mean(rows, axis=0).tolist())}"


def scans_of(folder: Path) -> SavedRobot:
    """What a folder has of its only robot."""
    (robot,) = graphslam.load_result(folder).robots.values()
    return robot


def off_final_m(path: Trajectory, final: Trajectory) -> tuple[float, float]:
    """How far poses are from the final ones, root mean square, m.

    First with all of them laid on these, then with the first pose laid on its own: that is how far
    off a robot is in the map that began where it did.
    """
    at = np.searchsorted(final.stamps_ns, path.stamps_ns)
    at = np.minimum(at, len(final.stamps_ns) - 1)
    same = final.stamps_ns[at] == path.stamps_ns
    own, best = path.poses[same], final.poses[at[same]]
    laid = transform(align(own[:, :2], best[:, :2]), own[:, :2])
    begun = compose(best[0], between(own[0], own))[:, :2]
    aligned, anchored = (
        float(np.sqrt(np.mean(np.sum((xy - best[:, :2]) ** 2, axis=1)))) for xy in (laid, begun)
    )
    return aligned, anchored


def drifting(folder: Path) -> Iterator[str]:
    """Causal errors of logs whose drift is larger than the estimate knows."""
    whole, part = folder / "whole.mcap", folder / "drifting.mcap"
    IMPORTERS["carmen"](FREIBURG / "aces.clf.bz2", whole)
    relations = read_relations(FREIBURG / "aces.relations")
    for kind, seed in (("original", 0), ("as-recorded", 0), ("noisy", 1), ("noisy", 2)):
        part.unlink(missing_ok=True)
        if kind == "original":
            shutil.copy(whole, part)
        else:
            messages = list(graphslam.open_logs(whole).messages())
            degraded = perturbed_logs.PERTURBATIONS[kind][0](messages, relations, seed)
            perturbed_logs.write(degraded, part)
        for closes in (True, False):
            now = folder / "now"
            graphslam.follow(part, now, force=True, backend={"close_loops": closes})
            found = graphslam.evaluate(now, relations=relations)["relations"]
            errors = ", ".join(f"{k} {found[k]['trans_mean_m']:.4f} m" for k in ("all", "loops"))
            yield f"aces {kind} {seed}, by {'places' if closes else 'landmarks alone'}: {errors}"


def told(errors_m: Sequence[Sequence[float]]) -> str:
    """Causal errors, m, live, by `--causal` with its horizon, and by `--causal`."""
    return "; ".join(
        f"{name} {relations:.4f} m (off the final poses, aligned {aligned:.3f}, "
        f"from the first pose on {anchored:.3f})"
        for name, (relations, aligned, anchored) in zip(
            ("live", "--causal, its horizon", "--causal"), errors_m, strict=True
        )
    )


def write_from(log: Path, target: Path, seconds: float) -> None:
    """Write a log without its first seconds; what is static stays."""
    found = list(messages_of(log))
    first = found[0][3] + round(1e9 * seconds)
    with target.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channels: dict[str, int] = {}
        for topic, schema, data, log_time in found:
            if log_time >= first or "static" in topic:
                add(writer, channels, topic, schema, log_time, data)
        writer.finish()


def soak(folder: Path, minutes: int) -> Iterator[str]:
    """Memory over a long drive of five robots."""
    log = record(folder / "long.mcap", 60 * minutes)
    starts = {f"robot{k}": true_poses(k, np.zeros(1))[0].tolist() for k in range(ROBOTS)}
    opened = graphslam.open_logs(log)
    session = graphslam.Session(start={"poses": starts})
    total = opened.count()
    memory, taken, estimates = [], 0, 0
    began = time.perf_counter()

    def counted() -> Iterator[Message]:
        nonlocal taken
        for message in opened.messages():
            taken += 1
            if taken * 20 // total > len(memory):
                memory.append(resident_mb())
            yield message

    off: list[float] = []
    for estimate in session.process(counted()):
        estimates += 1
        if estimates % 100 == 0:
            true = true_poses(int(estimate.robot[5:]), np.array([1e-9 * estimate.stamp_ns - 1.0]))[
                0
            ]
            off.append(float(np.hypot(*(estimate.pose - true)[:2])))
    half = memory[len(memory) // 2]
    yield (
        f"{minutes} min, {total} messages, {estimates} estimates in "
        f"{time.perf_counter() - began:.0f} s; error rms {np.sqrt(np.mean(np.square(off))):.3f} m; "
        f"memory, MB: {' '.join(f'{x:.0f}' for x in memory)}; last half "
        f"{100 * (memory[-1] / half - 1):+.1f} %"
    )


def resident_mb() -> float:
    """Resident memory of this process."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 / 1e6


if __name__ == "__main__":
    main()
