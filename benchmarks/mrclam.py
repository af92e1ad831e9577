"""MRCLAM set 6 with default settings: five robots that see landmarks and each other.

Imported, smoothed from the true start poses and evaluated by the commands that a user types; then
without sightings of robots, both also by the filter, without identities, with two codes exchanged
in the table of who bears which, with the start of one robot alone given, every robot by itself,
from its own messages, and the second half of the set, by itself and, with no start given, in the
map of the first half. Errors are root mean squares over all robots at 10 Hz over the whole log,
stretches without sightings included; s and CPU s are those of the whole `smooth` command with its
report.

Run: python benchmarks/mrclam.py [NAME ...], of robots, alone, ekf, ekf-alone, unnamed, exchanged,
start1 to start5, robot1 to robot5, half, in-map
"""

import tarfile
import tempfile
from pathlib import Path

from common import DATA, command, measured_command, parser
from mcap.reader import make_reader
from mcap.writer import Writer

from graphslam.core.config import Config
from graphslam.logs import LogWriter, open_logs
from graphslam.pipeline.start_priors import first_truth

SOURCE = DATA / "mrclam/MRCLAM_Dataset6.tar.xz"
RUNS = {
    "robots": [],
    "alone": ["--set", "association.robot_sightings=ignore"],
    "ekf": ["--backend", "ekf"],
    "ekf-alone": ["--backend", "ekf", "--set", "association.robot_sightings=ignore"],
    "unnamed": ["--set", "association.identities=ignore"],
    "exchanged": [],
    **{f"start{k}": [] for k in range(1, 6)},
    **{f"robot{k}": [] for k in range(1, 6)},
    "half": [],
    "in-map": [],
}
#: subjects of which the run `exchanged` has each bear the other's code
EXCHANGED = ("2", "9")
BARS = (
    "bars of robots: final 0.105, aligned 0.065, worst 0.13, NEES 2.0, landmarks 0.09, "
    "causal 0.124, 12 s; of unnamed: final 0.105, extra 0; of start1..5: 1.1 x robots"
)


def exchanged(folder: Path) -> Path:
    """The set with two codes exchanged in its table."""
    with tarfile.open(SOURCE) as archive:
        archive.extractall(folder / "exchanged-set", filter="data")
    (table,) = (folder / "exchanged-set").rglob("Barcodes.dat")
    rows = [line.split() for line in table.read_text().splitlines() if line[:1] != "#"]
    codes = {row[0]: row[1] for row in rows if row}
    a, b = EXCHANGED
    codes[a], codes[b] = codes[b], codes[a]
    table.write_text("".join(f"{subject} {code}\n" for subject, code in codes.items()))
    return table.parent


def by_itself(log: Path, robot: str, target: Path) -> Path:
    """The messages of one robot, and the true landmarks, as a log."""
    with log.open("rb") as source, target.open("wb") as stream:
        writer, channels = Writer(stream), dict[str, int]()
        writer.start()
        for schema, channel, message in make_reader(source).iter_messages():
            topic = channel.topic
            if topic != "/true_landmarks" and not topic.startswith(f"/{robot}/"):
                continue
            assert schema is not None
            if topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[topic] = writer.register_channel(topic, channel.message_encoding, number)
            writer.add_message(
                channels[topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()
    return target


def halves(log: Path, folder: Path) -> list[Path]:
    """The first half of a log, and the second."""
    with log.open("rb") as stream:
        found = [
            (channel.topic, schema.name, message.data, message.log_time)
            for schema, channel, message in make_reader(stream).iter_messages()
            if schema is not None
        ]
    times = [time_ns for *_, time_ns in found]
    middle = (min(times) + max(times)) // 2
    paths = [folder / "half0.mcap", folder / "half1.mcap"]
    for k, path in enumerate(paths):
        with LogWriter(path) as made:
            for topic, schema, data, time_ns in found:
                if (time_ns >= middle) == bool(k) or topic == "/true_landmarks":
                    made.encoded(topic, schema, data, time_ns)
    return paths


def row(name: str, log: Path, folder: Path) -> str:
    """One line of the table."""
    start = "truth"
    if name.startswith("start"):
        robot = name.replace("start", "robot")
        log_set = open_logs([log], Config())
        x, y, phi = first_truth(log_set)[robot]
        start = f"{robot}={x},{y},{phi}"
    options = ["--start", start, *RUNS[name]]
    if name in ("half", "in-map"):
        first, log = halves(log, folder)
    if name == "in-map":
        known = folder / "map"
        command("smooth", str(first), "--start", "truth", "-o", str(known))
        options = ["--prior-map", str(known)]
    _, used = measured_command("smooth", str(log), "-o", str(folder / name), *options)
    found = command("evaluate", str(folder / name), "--truth", str(log))
    final, causal = found["joint"]["final"], found["joint"]["causal"]
    worst = max(robot["final"]["ate_rmse_m"] for robot in found["robots"].values())
    landmarks = found["landmarks"]
    return (
        f"{name:9} {final['ate_rmse_m']:7.3f} {final['ate_aligned_rmse_m']:8.3f} {worst:6.3f} "
        f"{final['max_m']:5.2f} {final['nees_per_dof']:6.2f} {causal['ate_rmse_m']:7.3f} "
        f"{landmarks['rmse_m']:10.3f} {landmarks['missed']:7} {landmarks['extra']:6} "
        f"{used.wall_s:6.1f} {used.cpu_s:6.1f}"
    )


def main() -> None:
    """Print the table."""
    options = parser(__doc__)
    options.add_argument("names", nargs="*", choices=[*RUNS, []], default=[])
    names = options.parse_args().names or list(RUNS)
    with tempfile.TemporaryDirectory() as scratch:
        log = Path(scratch) / "mrclam6.mcap"
        _, used = measured_command("import", "mrclam", str(SOURCE), "-o", str(log))
        print(f"imported in {used.cpu_s:.1f} s")
        print(
            "run         final  aligned  worst   max   NEES  causal  landmarks  missed  extra"
            "      s  CPU s"
        )
        for name in names:
            source = log
            if name == "exchanged":
                source = Path(scratch) / "exchanged.mcap"
                command("import", "mrclam", str(exchanged(Path(scratch))), "-o", str(source))
            if name.startswith("robot") and name != "robots":
                source = by_itself(log, name, Path(scratch) / f"{name}.mcap")
            print(row(name, source, Path(scratch)), flush=True)
    print(BARS)


if __name__ == "__main__":
    main()
