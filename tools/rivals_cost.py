"""What the networks of `tools/rivals.sh` cost a pair: parameters, arithmetic and time on one core.

    python tools/rivals_cost.py --results results/rivals_cost.json

Each is built as its recipe says, with fresh weights, which are as fast as trained ones, and reads what its
recipe says: all matches, or the mutual ones, of which the validation pairs have 666 among 2,000. They take
turns, so that the ratios of their times mean something on a machine that other programs use.
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import click
import torch
from torch import Tensor
from torch.utils.flop_counter import FlopCounterMode

from corrsfm.config import MatchInput
from corrsfm.evaluation.records import provenance, save_results
from corrsfm.model import CorrAdaptor, NetworkConfig, Rival, RivalConfig, build_network
from corrsfm.training.config import load_recipe

RECIPES = Path(__file__).resolve().parents[1] / "pipelines"
NAMES = (
    "corradaptor", "pointcn", "oanet", "lmcnet", "ms2dgnet", "clnet", "pgfnet", "convmatch", "ncmnet",
    "mgnet", "umatch", "corradaptor_side", "ms2dgnet_side", "oanet_side", "pgfnet_side",
)  # fmt: skip


def network_of(name: str, num_matches: int, num_mutual: int) -> tuple[CorrAdaptor | Rival, list[Tensor]]:
    """The network of a recipe, with fresh weights, and a pair as it reads one."""
    torch.manual_seed(0)
    recipe = load_recipe(RECIPES / f"train_{name}.toml")
    shape = recipe.network
    config = RivalConfig(**shape) if "architecture" in shape else NetworkConfig(**shape)
    num = num_mutual if recipe.train.input is MatchInput.MUTUAL else num_matches
    inputs = [0.3 * torch.randn(1, num, 4)]
    if config.side_channels:
        inputs.append(torch.rand(1, num, config.side_channels))
    return build_network(config).eval(), inputs


@click.command()
@click.option("--num-matches", default=2000, show_default=True)
@click.option("--num-mutual", default=666, show_default=True)
@click.option("--rounds", default=7, show_default=True)
@click.option("--results", type=click.Path(path_type=Path))
def main(num_matches: int, num_mutual: int, rounds: int, results: Path | None) -> None:
    """Measure what each network costs."""
    torch.set_num_threads(1)
    networks = {name: network_of(name, num_matches, num_mutual) for name in NAMES}
    seconds: dict[str, list[float]] = {name: [] for name in NAMES}
    rows = {}
    with torch.inference_mode():
        for name, (network, inputs) in networks.items():
            with FlopCounterMode(display=False) as counter:
                network(*inputs)
            rows[name] = {
                "num_matches": inputs[0].shape[1],
                "parameters": sum(weights.numel() for weights in network.parameters()),
                "gflop": round(counter.get_total_flops() / 1e9, 3),
            }
        for _ in range(rounds):
            for name, (network, inputs) in networks.items():
                started = time.perf_counter()
                network(*inputs)
                seconds[name].append(time.perf_counter() - started)
    for name, row in rows.items():
        row["ms"] = round(1000 * statistics.median(seconds[name]), 2)
        print(f"{name:12} {row['parameters']:>9,} {row['gflop']:8.2f} GFLOP {row['ms']:8.1f} ms")
    if results is not None:
        command = "python tools/rivals_cost.py --results results/rivals_cost.json"
        save_results(results, "costs", {"provenance": provenance(seed=0, command=command), "rows": rows})


if __name__ == "__main__":
    main()
