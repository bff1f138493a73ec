"""The command that measures the network's speed and memory."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import click

from corrsfm.cli.options import PATH, RESULT_FILE, echo_json, json_option, run_options
from corrsfm.config import Precision, RunConfig

__all__ = ["bench"]

# With many more the system ends the process for want of memory, without a word.
LARGEST_SIZE = 50_000
LARGEST_BATCH = 1024


@click.command()
@click.option(
    "--model",
    type=PATH,
    help="Checkpoint; the published architecture if not given.",
)
@click.option(
    "--num-matches",
    "sizes",
    type=click.IntRange(min=32, max=LARGEST_SIZE),
    multiple=True,
    default=(500, 1000, 2000),
    show_default=True,
    help="Matches a pair; give it several times.",
)
@click.option(
    "--batch-size",
    "batch_sizes",
    type=click.IntRange(min=1, max=LARGEST_BATCH),
    multiple=True,
    default=(1,),
    show_default=True,
    help="Pairs at a time; give it several times.",
)
@click.option(
    "--precision",
    "precisions",
    type=click.Choice(["float32", "bfloat16"]),
    multiple=True,
    default=("float32", "bfloat16"),
    show_default=True,
    help="Number formats.",
)
@click.option(
    "--compile/--no-compile", default=False, show_default=True, help="Also measure the compiled network."
)
@click.option(
    "--repeats", type=click.IntRange(min=1), default=3, show_default=True, help="Timed repetitions."
)
@run_options
@click.option("--results", type=RESULT_FILE, help="Also write a result file here.")
@json_option
def bench(
    model: Path | None,
    sizes: tuple[int, ...],
    batch_sizes: tuple[int, ...],
    precisions: tuple[str, ...],
    compile: bool,
    repeats: int,
    run: RunConfig,
    results: Path | None,
    as_json: bool,
) -> None:
    """Measure the network's speed and memory.

    The reference is the published network, written plainly, in the same run.

    Numbers marked × are ratios to that reference on the same matches: of pairs per second, and of peak
    memory.
    """  # fmt: skip
    from corrsfm.cli.evaluate import command_line
    from corrsfm.evaluation.benchmark import format_rows, run_benchmark
    from corrsfm.evaluation.records import provenance, save_results
    from corrsfm.machine import count_threads, find_device, use_threads

    use_threads(count_threads(run.threads))
    device = find_device(run.device)
    devices = sorted({"cpu", device}) if run.device == "auto" else [device]
    rows = run_benchmark(
        model=model,
        devices=devices,
        sizes=sizes,
        batch_sizes=batch_sizes,
        precisions=[Precision(name) for name in precisions],
        compile=compile,
        repeats=repeats,
        seed=run.seed,
    )
    if results is not None:
        save_results(
            results,
            "bench",
            {
                "provenance": provenance(seed=run.seed, command=command_line(), device=devices[-1]),
                "subject": {
                    "model": str(model or "the published architecture"),
                    "threads": count_threads(run.threads),
                },
                "rows": [dataclasses.asdict(row) for row in rows],
            },
        )
    if as_json:
        echo_json([dataclasses.asdict(row) for row in rows])
    else:
        click.echo(format_rows(rows))
