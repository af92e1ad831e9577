"""What a graph per robot with condensed messages costs, compared with one graph of all robots.

The same recorded steps are replayed into both by `graphslam compare`, for several intervals between
messages, with messages that are lost and late, and with names of landmarks of each robot's own:
MRCLAM set 6, from the true start poses, and the thesis' two robots with lasers (simulated). Errors
are root mean squares over all robots, from the centralised estimate ("loss") and from the truth, m;
kB are what each robot sends on average, and what it measured; s is the time of the replay.

Run: python benchmarks/decentralised.py [mrclam|two-robots ...] [SECONDS ...]
"""

import tempfile
from pathlib import Path

from common import DATA, command, parser

LOGS = {
    "mrclam": ["import", "mrclam", str(DATA / "mrclam/MRCLAM_Dataset6.tar.xz")],
    "two-robots": ["simulate", "two-robots", "--seed", "0"],
}
PERIODS_S = ("10", "30", "120")
#: with messages every 10 s
NETWORKS = (
    "network.loss_ratio=0.3",
    "network.delay_s=60",
    "network.loss_ratio=0.3+network.delay_s=60",
    "network.landmarks=own",
)


def show(row: dict) -> None:
    """One line of the table."""
    if row["error"]:
        print(f"{row['label']:52} {row['error']}", flush=True)
        return
    final, causal = row["joint"]["final"], row["joint"]["causal"]
    messages = row.get("exchanged", {}).values()
    sent, measured = (
        f"{sum(one[key] for one in messages) / len(messages) / 1e3:7.0f}" if messages else "      -"
        for key in ("sent_bytes", "measured_bytes")
    )
    loss = row["difference"]["final"]["rmse_m"]
    print(
        f"{row['label']:52} {final['ate_rmse_m']:7.4f} {final['nees_per_dof']:6.2f} {loss:7.4f} "
        f"{causal['ate_rmse_m']:7.4f} {causal['nees_per_dof']:6.2f} {sent} {measured} "
        f"{row['total_s']:6.1f}",
        flush=True,
    )


def main() -> None:
    """Print the tables."""
    options = parser(__doc__)
    options.add_argument("given", nargs="*", metavar="NAME or SECONDS")
    given = options.parse_args().given
    names = [name for name in given if name in LOGS] or list(LOGS)
    periods_s = [name for name in given if name not in LOGS] or list(PERIODS_S)
    specs = ["batch", *(f"decentralised+backend.exchange_s={t}" for t in periods_s)]
    if len(periods_s) == len(PERIODS_S):
        specs += [f"decentralised+backend.exchange_s=10+{network}" for network in NETWORKS]
    with tempfile.TemporaryDirectory() as scratch:
        for name in names:
            log = Path(scratch) / f"{name}.mcap"
            command(*LOGS[name], "-o", str(log))
            found = command(
                *("compare", str(log), "--start", "truth", "--backends", ",".join(specs)),
                *("-o", str(Path(scratch) / name)),
            )
            print(
                f"{name:52}   final   NEES    loss  causal   NEES kB sent kB meas.      s",
                flush=True,
            )
            for row in found["rows"]:
                show(row)


if __name__ == "__main__":
    main()
