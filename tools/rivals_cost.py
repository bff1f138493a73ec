"""What the networks of `tools/rivals.sh` cost a pair: parameters, arithmetic and time on one core.

    python tools/rivals_cost.py --results results/rivals_cost.json

Each is built as its recipe says, with fresh weights, which are as fast as trained ones. They take turns, so
that the ratios of their times mean something on a machine that other programs use.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import click
import torch
from torch.utils.flop_counter import FlopCounterMode

from corrsfm.evaluation.records import provenance, save_results
from corrsfm.model import CorrAdaptor, NetworkConfig, Rival, RivalConfig, build_network
from corrsfm.training.config import load_recipe

RECIPES = Path(__file__).resolve().parents[1] / "pipelines"
NAMES = (
    "corradaptor", "pointcn", "oanet", "lmcnet", "ms2dgnet", "clnet", "pgfnet", "convmatch", "ncmnet",
    "mgnet", "umatch",
)  # fmt: skip


def network_of(name: str) -> CorrAdaptor | Rival:
    """The network of a recipe, with fresh weights."""
    torch.manual_seed(0)
    shape = load_recipe(RECIPES / f"train_{name}.toml").network
    config = RivalConfig(**shape) if "architecture" in shape else NetworkConfig(**shape)
    return build_network(config).eval()


@click.command()
@click.option("--num-matches", default=2000, show_default=True)
@click.option("--rounds", default=7, show_default=True)
@click.option("--results", type=click.Path(path_type=Path))
def main(num_matches: int, rounds: int, results: Path | None) -> None:
    """Measure what each network costs."""
    torch.set_num_threads(1)
    networks = {name: network_of(name) for name in NAMES}
    matches = torch.randn(1, num_matches, 4, generator=torch.Generator().manual_seed(0)) * 0.3
    seconds: dict[str, list[float]] = {name: [] for name in NAMES}
    rows = {}
    with torch.inference_mode():
        for name, network in networks.items():
            with FlopCounterMode(display=False) as counter:
                network(matches)
            rows[name] = {
                "parameters": sum(weights.numel() for weights in network.parameters()),
                "gflop": round(counter.get_total_flops() / 1e9, 3),
            }
        for _ in range(rounds):
            for name, network in networks.items():
                started = time.perf_counter()
                network(matches)
                seconds[name].append(time.perf_counter() - started)
    for name, row in rows.items():
        row["ms"] = round(1000 * statistics.median(seconds[name]), 2)
        print(f"{name:12} {row['parameters']:>9,} {row['gflop']:8.2f} GFLOP {row['ms']:8.1f} ms")
    if results is not None:
        command = "python tools/rivals_cost.py --results results/rivals_cost.json"
        values = {"num_matches": num_matches, "rows": rows}
        save_results(results, "costs", {"provenance": provenance(seed=0, command=command), **values})


if __name__ == "__main__":
    main()
