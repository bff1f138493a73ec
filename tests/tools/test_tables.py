"""Tables in documents come from result files and from nowhere else."""

import re
from pathlib import Path

import pytest
from two_view_pairs import make_pair

from corrsfm.errors import InputError
from corrsfm.evaluation.records import load_results
from corrsfm.evaluation.tables import Table
from corrsfm.evaluation.two_view.pose import evaluate_pose
from corrsfm.labelled.oanet import write_pairs
from tools.tables import DOCUMENTS, choose, main, render_document

COMMAND = "corrsfm evaluate pose 'my pairs.h5' --method mutual/poselib --max-per-scene 40 --threads 1"


@pytest.fixture(scope="module")
def results_dir(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("results")
    write_pairs(folder / "pairs.h5", [make_pair(seed=i, num=80, scene="a") for i in range(4)])
    evaluate_pose(
        folder / "pairs.h5",
        ["mutual/poselib", "oracle/poselib"],
        results=folder / "two_view.json",
        command=COMMAND,
    )
    return folder


DOCUMENT = "# Title\n\n<!-- table:two_view -->\nold\n<!-- /table -->\n\nafter\n"
CHOICE = """<!-- table:two_view
rows: oracle / poselib = the right ones; mutual / poselib (baseline)
columns: recall; AUC@5 [95 %] = AUC
-->
<!-- /table -->
"""


def test_only_what_is_between_the_markers_changes(results_dir: Path) -> None:
    rendered = render_document(DOCUMENT, results_dir)
    assert rendered.startswith("# Title\n\n<!-- table:two_view -->\n| filter")
    assert rendered.endswith("\n<!-- /table -->\n\nafter\n")
    assert "old" not in rendered
    assert render_document(rendered, results_dir) == rendered


def test_a_marker_chooses_rows_and_columns_and_what_they_are_called(results_dir: Path) -> None:
    rendered = render_document(CHOICE, results_dir)
    lines = rendered.removeprefix(CHOICE.split("-->")[0] + "-->\n").splitlines()
    summaries = {
        name: method["summary"]
        for name, method in load_results(results_dir / "two_view.json")["methods"].items()
    }
    right, mutual = (summaries[f"{name}/poselib"] for name in ("oracle", "mutual"))
    assert lines[0] == "| filter / estimator | recall | AUC |"
    assert lines[2].startswith(f"| the right ones | {right['recall']:.1f} | {right['auc']['5']:.1f} [")
    assert lines[3].startswith(f"| mutual / poselib (baseline) | {mutual['recall']:.1f} | ")
    assert lines[5].startswith("4 pairs of 1 scenes")
    assert render_document(rendered, results_dir) == rendered


def test_the_first_column_stays_and_may_be_renamed() -> None:
    table = Table(
        header=["a", "b", "c"], rows=[["x", "1", "2"], ["y", "3", "4"], ["y", "5", "6"]], caption=""
    )
    assert choose(table, {}, {}, "") == table
    assert choose(table, {}, {"c": "C"}, "").rows == [["x", "2"], ["y", "4"], ["y", "6"]]
    chosen = choose(table, {"y": "Y"}, {"a": "A", "b": "b"}, "")
    assert (chosen.header, chosen.rows) == (["A", "b"], [["Y", "3"]])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (
            "mutual / poselib (baseline)",
            "mutual",
            r"README.md, table:two_view: no mutual; there are mutual /",
        ),
        ("recall;", "memory;", "no memory; there are filter / estimator, AUC@5"),
        ("columns:", "colums: a\ncolumns:", "no mutual / poselib .baseline. colums: a"),
        ("\nrows:", "\nlines: all\nrows:", "'lines: all' is neither 'rows: …' nor 'columns: …'"),
    ],
)
def test_a_choice_that_the_table_does_not_have_is_refused(
    results_dir: Path, old: str, new: str, message: str
) -> None:
    assert old in CHOICE
    with pytest.raises(InputError, match=message):
        render_document(CHOICE.replace(old, new), results_dir, where="README.md")


def test_a_command_measures_all_methods_of_its_file_and_is_folded_before_flags(results_dir: Path) -> None:
    rendered = render_document("<!-- command:two_view -->\n<!-- /command -->\n", results_dir)
    assert rendered == (
        "<!-- command:two_view -->\n```bash\n"
        "corrsfm evaluate pose 'my pairs.h5' --max-per-scene 40 --threads 1 --method mutual/poselib \\\n"
        "    --method oracle/poselib\n```\n<!-- /command -->\n"
    )


def test_table_without_a_file_behind_it_does_not_exist(results_dir: Path) -> None:
    with pytest.raises(InputError, match=r"made_up\.json: no such file"):
        render_document(DOCUMENT.replace("two_view", "made_up"), results_dir)


@pytest.mark.parametrize(
    "text",
    [
        DOCUMENT.replace("<!-- /table -->", ""),
        "<!-- /table -->",
        DOCUMENT + "<!-- table:x -->\n",
        "<!-- command:two_view -->\n<!-- /table -->\n",
    ],
)
def test_open_markers_are_refused(results_dir: Path, text: str) -> None:
    with pytest.raises(InputError, match="must alternate"):
        render_document(text, results_dir, where="README.md")


def test_command_renders_and_checks(
    results_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    document = tmp_path / "README.md"
    document.write_text(DOCUMENT)
    arguments = [str(document), "--results-dir", str(results_dir)]
    with pytest.raises(SystemExit, match=r"tables differ from their results in .*README\.md"):
        main([*arguments, "--check"])
    assert document.read_text() == DOCUMENT
    main(arguments)
    assert "| oracle / poselib |" in document.read_text()
    assert capsys.readouterr().out == f"{document}: tables written\n"
    main([*arguments, "--check"])
    with pytest.raises(SystemExit, match=r"nowhere\.md: not readable"):
        main([str(tmp_path / "nowhere.md")])


def test_tables_of_the_projects_documents_match_the_results(repository: Path) -> None:
    assert [path.relative_to(repository).as_posix() for path in DOCUMENTS] == [
        "README.md",
        "results/README.md",
    ]
    for path in DOCUMENTS:
        text = path.read_text(encoding="utf-8")
        assert "<!-- table:" in text
        assert render_document(text, repository / "results", where=path.name) == text, "run: make tables"


def test_every_result_file_has_a_table_on_the_results_page(repository: Path) -> None:
    names = {path.stem for path in (repository / "results").glob("*.json")}
    assert len(names) >= 10
    page = (repository / "results" / "README.md").read_text(encoding="utf-8")
    assert set(re.findall(r"<!-- table:([\w.-]+)", page)) == names
    assert set(re.findall(r"<!-- command:([\w.-]+)", page)) == names
