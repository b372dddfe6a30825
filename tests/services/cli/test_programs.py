"""Commands for programs: what they refuse, and what their help says."""

from pathlib import Path

from click.testing import CliRunner

from services.cli.main import main


def test_help_names_the_file_beside_a_video_as_it_is_written() -> None:
    for name in ("patterns", "tether"):
        described = CliRunner().invoke(main, [name, "--help"]).stdout
        assert (".json" in described, "capture.json" in described) == (True, False), name


def test_a_file_without_a_program_is_named(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text("{}")
    file = str(tmp_path / "bad.json")
    for command in (
        ["patterns", file, str(tmp_path / "out")],
        ["pack", file, str(tmp_path), "-o", str(tmp_path / "x.zip")],
        ["tether", file, str(tmp_path)],
    ):
        done = CliRunner().invoke(main, command)
        assert done.exit_code == 2
        assert f"{file} has no program: monitor is required" in done.stderr
