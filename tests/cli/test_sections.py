"""Help in sections: what people use first, then a heading a stage; every flag once."""

import dataclasses
import re

import click
import pytest
from click.testing import CliRunner

from corrsfm import config as cfg
from corrsfm.cli import main
from corrsfm.cli.options import config_options, json_option
from corrsfm.cli.sections import SectionedCommand, section_of
from corrsfm.config.fields import flag_of

STAGES = ["images", "features", "pairs", "matches", "prune", "database", "reconstruction"]


def sections_of(command: str) -> dict[str, list[str]]:
    """The flags under each heading of a command's help, in order."""
    result = CliRunner().invoke(main, [command, "--help"])
    assert result.exit_code == 0, result.output
    sections: dict[str, list[str]] = {}
    for line in result.output.splitlines():
        if heading := re.fullmatch(r"(\S.*):", line):
            sections[heading[1]] = []
        elif sections and (flag := re.match(r"  (?:-\w, )?(--[a-z][a-z-]*)", line)):
            sections[list(sections)[-1]].append(flag[1])
    return sections


def flags_of_table(table: str) -> list[str]:
    """Flags of one table of a pipeline file."""
    config = getattr(cfg.PipelineConfig(), table)
    return [flag_of(entry.name) for entry in dataclasses.fields(config)]


@pytest.mark.parametrize(
    ("command", "most_used", "tables"),
    [
        (
            "run",
            ["--method", "--max-features", "--camera-mode", "--pairing", "--pipeline"],
            [*STAGES, "run"],
        ),
        (
            "compare",
            ["--methods", "--seeds", "--output", "--ground-truth", "--max-features", "--pipeline"],
            [*STAGES, "run"],
        ),
        ("extract", ["--max-features", "--camera-mode", "--pairing"], [*STAGES[:4], "run"]),
        ("prune", [], ["prune", "database", "run"]),
    ],
)
def test_options_are_listed_by_stage_below_the_most_used(
    command: str, most_used: list[str], tables: list[str]
) -> None:
    sections = sections_of(command)
    assert sections.pop("Most used", []) == most_used
    general = sections.pop("General")
    assert [heading.split(" – ")[0] for heading in sections] == tables
    # The flag of one method has no place where several are compared.
    elsewhere = {*most_used, *(["--method"] if command == "compare" else [])}
    for table, flags in zip(tables, sections.values(), strict=True):
        assert flags == [flag for flag in flags_of_table(table) if flag not in elsewhere]
    assert general[-3:] == ["--overwrite", "--json", "--help"]


@pytest.mark.parametrize("command", ["run", "compare", "extract", "prune", "reconstruct", "pairs", "match"])
def test_every_flag_is_listed_once(command: str) -> None:
    listed = [flag for flags in sections_of(command).values() for flag in flags]
    known = {
        parameter.opts[-1]
        for parameter in main.commands[command].params
        if isinstance(parameter, click.Option) and not parameter.hidden
    }
    assert len(listed) == len(set(listed)) > 6
    assert set(listed) == {*known, "--help"}


def test_flags_stand_in_one_column_through_all_sections() -> None:
    output = CliRunner().invoke(main, ["run", "--help"]).output
    texts = [re.match(r"  --[a-z-]+(?: [A-Z]+)?( {2,})\S", line) for line in output.splitlines()]
    columns = {text.end() for text in texts if text}
    assert len([text for text in texts if text]) > 15 and len(columns) == 1


def test_switches_are_on_or_off_by_default() -> None:
    output = " ".join(CliRunner().invoke(main, ["run", "--help"]).output.split())
    assert "--root-sift / --no-root-sift Hellinger-normalise descriptors (RootSIFT). [default: on]" in output
    assert "Also estimate the principal point. [default: off]" in output
    assert "[default: no-" not in output


def test_a_heading_names_the_table_and_says_what_it_is_about() -> None:
    assert section_of(cfg.FeaturesConfig) == "features – keypoints and descriptors"
    assert section_of(cfg.ReconstructionConfig) == "reconstruction – mapping by pycolmap"


def test_compare_refuses_the_flag_that_its_help_leaves_out() -> None:
    assert "--method " not in CliRunner().invoke(main, ["compare", "--help"]).output
    result = CliRunner().invoke(main, ["compare", "photos", "--method", "ratio"])
    assert result.exit_code == 2 and "name those to compare with --methods" in result.output


def test_a_most_used_option_that_does_not_exist_is_an_error() -> None:
    @click.command(cls=SectionedCommand, most_used=("methd",))
    @config_options(prune=cfg.PruneConfig)
    @json_option
    def command(prune: cfg.PruneConfig, as_json: bool) -> None:
        """A command with a slip of the pen."""

    assert isinstance(CliRunner().invoke(command, ["--help"]).exception, KeyError)
