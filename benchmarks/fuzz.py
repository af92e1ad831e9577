"""A coverage-guided search for bytes that a reader neither takes nor refuses in one line.

Atheris (libFuzzer; `pip install ".[fuzz]"`) changes bytes such that branches of the readers are run
that were not run before. Every container, the decoders of messages, every importer, the reader of
settings and that of checkpoints (tests/hostile_bytes.py) have their share of the time, each in a
process of its own with 2 GB of memory and 60 s for one input. What was found (an exception that is
no error of one line, a hang, too much memory) is written to DIR/finds, once for each place in the
code; tests/logs/test_hostile_bytes.py keeps those that were mended.

Run: python benchmarks/fuzz.py [DIR] [--minutes 10] [--target NAME]
exit code 1 if anything was found.
"""

import argparse
import hashlib
import re
import shutil
import subprocess
import sys
import tempfile
import traceback
import warnings
from pathlib import Path

# nothing of the package is imported before atheris is there: what is, it does not look at
# ruff: noqa: PLC0415
ROOT = Path(__file__).parents[1]
MEMORY_MB, LIMIT_S, LONGEST_BYTES = 2000, 60, 200_000
#: packages whose branches are looked at
LOOKED_AT = ["graphslam.logs", "graphslam.importers", "graphslam.core", "mcap"]


def fuzz(name: str, folder: Path, seconds: int) -> None:
    """Search in this process, which ends with that."""
    import atheris

    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    with atheris.instrument_imports(include=LOOKED_AT):
        import importlib

        for package in ("logs", "importers"):
            for path in sorted((ROOT / "graphslam" / package).glob("*.py")):
                name = f"graphslam.{package}.{path.stem}".removesuffix(".__init__")
                importlib.import_module(name)
        import hostile_bytes
    target = hostile_bytes.TARGETS[name]
    warnings.simplefilter("error")  # a warning of Python is no message for people
    corpus, finds = folder / "corpus" / _plain(name), folder / "finds"
    for path in (corpus, finds):
        path.mkdir(parents=True, exist_ok=True)
    for k, seed in enumerate(target.seeds()):
        (corpus / f"seed-{k}").write_bytes(seed)
    found: set[str] = set()
    place = Path(tempfile.mkdtemp(dir="/dev/shm" if Path("/dev/shm").is_dir() else None))

    def once(data: bytes) -> None:
        inside = place / "one"
        inside.mkdir()
        try:
            hostile_bytes.refused(lambda: target.take(data, inside))
        except Exception as error:  # whatever it is, it is what is looked for
            at = traceback.extract_tb(error.__traceback__)[-1]
            where = f"{type(error).__name__} {Path(at.filename).name}:{at.lineno}"
            if where not in found:
                found.add(where)
                stem = f"{_plain(name)}-{hashlib.sha256(where.encode()).hexdigest()[:8]}"
                (finds / f"{stem}.bytes").write_bytes(data)
                (finds / f"{stem}.txt").write_text(traceback.format_exc(), encoding="utf-8")
        finally:
            shutil.rmtree(inside, ignore_errors=True)

    atheris.Setup(
        [
            sys.argv[0], f"-max_total_time={seconds}", f"-timeout={LIMIT_S}", "-seed=1",
            f"-rss_limit_mb={MEMORY_MB}", f"-max_len={LONGEST_BYTES}", "-print_final_stats=1",
            f"-artifact_prefix={finds}/{_plain(name)}-", str(corpus),
        ],
        once,
    )  # fmt: skip
    atheris.Fuzz()


def _plain(name: str) -> str:
    return re.sub(r"\W+", "-", name)


def main() -> int:
    options = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    options.add_argument("folder", nargs="?", type=Path, default=Path("out/fuzz"))
    options.add_argument("--minutes", type=float, default=10.0)
    options.add_argument("--target", help="only this one, in this process")
    arguments = options.parse_args()
    if arguments.target:
        fuzz(arguments.target, arguments.folder, round(60 * arguments.minutes))
        return 0
    sys.path[:0] = [str(ROOT), str(ROOT / "tests")]
    import hostile_bytes

    share = arguments.minutes / len(hostile_bytes.TARGETS)
    print("| reader | inputs | branches at first | branches | finds |\n|---|---|---|---|---|")
    total = 0
    for name in hostile_bytes.TARGETS:
        words = [sys.executable, __file__, str(arguments.folder), "--target", name]
        done = subprocess.run(
            [*words, "--minutes", str(share)], stderr=subprocess.PIPE, text=True, check=False
        )
        covered = re.findall(r"cov: (\d+)", done.stderr) or ["0"]
        inputs = re.findall(r"number_of_executed_units: (\d+)", done.stderr) or ["?"]
        finds = [
            path
            for path in (arguments.folder / "finds").glob(f"{_plain(name)}-*")
            if path.suffix != ".txt"
        ]
        total += len(finds)
        print(
            f"| {name} | {inputs[-1]} | {covered[0]} | {covered[-1]} | {len(finds)} |", flush=True
        )
        if inputs == ["?"]:
            print(done.stderr[-2000:])
    return 1 if total else 0


if __name__ == "__main__":
    sys.exit(main())
