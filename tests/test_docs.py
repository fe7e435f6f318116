"""The pages say what the program does: names, symbols and the README's first script."""

import re
import tomllib
from pathlib import Path

import pytest

import overtone as ot
from overtone.contact.table import PAGE, markdown
from overtone.quantities import known_quantities

ROOT = Path(__file__).parents[1]


def test_the_glossary_is_the_table_of_quantities() -> None:
    rows = re.findall(
        r"^\| `(\w+)` \| ([^|]+) \| ([^|]+) \| (.+) \|$", (ROOT / "docs/glossary.md").read_text(), re.M
    )
    expected = {(q.name, q.symbol or "-", q.unit, q.meaning) for q in known_quantities()}
    assert set(rows) == expected


def test_the_page_of_models_is_the_registry() -> None:
    assert (ROOT / "docs/models.md").read_text(encoding="utf-8") == PAGE + markdown()


def test_the_first_script_of_the_readme_runs(capsys: pytest.CaptureFixture[str]) -> None:
    script = re.search(r"```python\n(.+?)```", (ROOT / "README.md").read_text(), re.S)
    assert script is not None
    exec(compile(script.group(1), "README.md", "exec"), {})
    numbers = [float(x) for x in re.findall(r"\d+", capsys.readouterr().out)]
    modulus, _, low, high = numbers
    assert low < 94 < high
    assert modulus == pytest.approx(94, rel=0.05, abs=0)


def test_every_public_name_is_importable() -> None:
    for name in ot.__all__:
        assert getattr(ot, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        ot.nonsense  # noqa: B018


def test_the_probe_file_of_the_docs_is_a_probe() -> None:
    text = re.search(r"```toml\n(.+?)```", (ROOT / "docs/files.md").read_text(), re.S)
    assert text is not None
    from overtone.probe import parse_probe

    assert parse_probe(text.group(1)).tip.radius == 10e-9


def test_the_readme_names_the_commands_that_ci_runs() -> None:
    readme, script = (ROOT / "README.md").read_text(), (ROOT / ".ci/run").read_text()
    assert "\npython -m pip install . && overtone demo\n" in readme
    assert "pip install --quiet . && overtone demo" in script
    command = 'python -m pip install -e ".[test]" && python -m pytest -n auto'
    assert f"\n{command}\n" in readme
    assert command.replace("install -e", "install --quiet -e") in script


def test_files_that_belong_to_the_project_are_where_they_should_be() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())
    assert settings["project"]["license"] == "BSD-3-Clause"
    targets = re.findall(r"^([a-z]+):  ## ", (ROOT / "Makefile").read_text(), re.M)
    assert {"install", "test", "lint", "format", "bench", "demo"} <= set(targets)
