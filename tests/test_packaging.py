"""What leaves the repository: the wheel holds the package alone and works by itself, the sdist can rebuild all."""

import email.message
import email.parser
import os
import re
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path, PurePosixPath

import pytest
import yaml

import sd_friction_env

ROOT = Path(__file__).resolve().parent.parent
VERSION = sd_friction_env.__version__


def run(*command: str | Path, cwd: Path, **environment: str) -> str:
    """Run a command, show what it printed if it failed, return its standard output."""
    words = [str(part) for part in command]
    result = subprocess.run(words, cwd=cwd, env=os.environ | environment, capture_output=True, text=True, check=False)
    assert result.returncode == 0, f"{command} failed:\n{result.stdout}\n{result.stderr}"
    return result.stdout


@pytest.fixture(scope="module")
def distributions(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the sdist from the repository and the wheel from the sdist, as a release does."""
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--no-isolation", "--outdir", folder, ROOT, cwd=folder)
    return folder


@pytest.fixture(scope="module")
def wheel(distributions: Path) -> Path:
    return distributions / f"sd_friction_env-{VERSION}-py3-none-any.whl"


@pytest.fixture(scope="module")
def wheel_files(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


@pytest.fixture(scope="module")
def metadata(wheel: Path) -> email.message.Message:
    with zipfile.ZipFile(wheel) as archive:
        text = archive.read(f"sd_friction_env-{VERSION}.dist-info/METADATA").decode()
    return email.parser.Parser().parsestr(text)


def test_the_wheel_holds_the_package_alone(wheel_files: set[str]) -> None:
    assert {PurePosixPath(name).parts[0] for name in wheel_files} == {
        "sd_friction_env",
        f"sd_friction_env-{VERSION}.dist-info",
    }


def test_the_wheel_holds_every_module_and_the_type_marker(wheel_files: set[str]) -> None:
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "sd_friction_env").rglob("*.py")}
    assert {name for name in wheel_files if name.endswith(".py")} == modules
    assert "sd_friction_env/py.typed" in wheel_files


def test_the_wheel_holds_the_hyperparameters_of_the_checkout(wheel: Path, wheel_files: set[str]) -> None:
    checkout = {path.name: path.read_bytes() for path in (ROOT / "agents" / "hyperparameters").glob("*.yml")}
    assert checkout
    prefix = "sd_friction_env/agents/hyperparameters/"
    assert {name.removeprefix(prefix) for name in wheel_files if name.startswith(prefix)} == set(checkout)
    with zipfile.ZipFile(wheel) as archive:
        assert {name: archive.read(prefix + name) for name in checkout} == checkout


def test_no_cache_is_shipped(distributions: Path, wheel_files: set[str]) -> None:
    with tarfile.open(distributions / f"sd_friction_env-{VERSION}.tar.gz") as archive:
        shipped = wheel_files | set(archive.getnames())
    assert not [name for name in shipped if "__pycache__" in name or name.endswith((".nbi", ".nbc", ".pyc"))]


def test_the_sdist_can_rebuild_and_test_all(distributions: Path) -> None:
    root = f"sd_friction_env-{VERSION}"
    with tarfile.open(distributions / f"{root}.tar.gz") as archive:
        files = set(archive.getnames())
    documents = {"CHANGELOG.md", "CITATION.cff", "CONTRIBUTING.md", "LICENSE", "README.md"}
    expected = documents | {".ci/run", ".github/workflows/test.yml", "Makefile", "constraints.txt", "pyproject.toml"}
    for folder, pattern in [("sd_friction_env", "*.py"), ("agents", "*.py"), ("scripts", "*.py"), ("tests", "*.py")]:
        expected |= {path.relative_to(ROOT).as_posix() for path in (ROOT / folder).rglob(pattern)}
    assert {f"{root}/{name}" for name in expected} - files == set()


def test_the_metadata_says_what_a_user_must_know(metadata: email.message.Message) -> None:
    assert metadata["Name"] == "sd-friction-env"
    assert metadata["Version"] == VERSION
    assert metadata["Requires-Python"] == ">=3.11"
    assert metadata["License-Expression"] == "MIT"
    description = str(metadata.get_payload())  # the README, shown by the package index
    assert "# sd_friction_env" in description
    assert not re.search(r"\]\((?!https://|#)", description)  # relative links lead nowhere there
    assert {"plot", "render", "train", "zoo", "all", "dev"} <= set(metadata.get_all("Provides-Extra", []))


def test_the_base_install_is_light(metadata: email.message.Message) -> None:
    base = {line for line in metadata.get_all("Requires-Dist", []) if "extra ==" not in line}
    assert {line.partition(">=")[0] for line in base} == {"gymnasium", "numba", "numpy", "scipy"}


def test_the_citation_names_the_current_version() -> None:
    assert yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))["version"] == VERSION


def test_every_requirement_is_pinned(metadata: email.message.Message) -> None:
    lines = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()
    pinned = {line.partition("==")[0].lower().replace("_", "-") for line in lines if "==" in line}
    lines = [line for line in metadata.get_all("Requires-Dist", []) if ">=" in line]
    required = {re.split(r"[\[>]", line)[0].lower() for line in lines}
    assert "gymnasium" in required
    assert required - pinned == set()


def test_an_installed_wheel_works_without_the_repository(wheel: Path, tmp_path: Path) -> None:
    target = tmp_path / "installed"
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "install", "--quiet", "--no-index", "--no-deps"]
    run(*pip, "--target", target, wheel, cwd=tmp_path)
    program = (
        "import gymnasium, importlib.resources, sd_friction_env\n"
        "print(sd_friction_env.__file__)\n"
        "print(sd_friction_env.__version__)\n"
        "print('SDFriction/Force-v0' in gymnasium.registry)\n"
        "folder = importlib.resources.files(sd_friction_env) / 'agents' / 'hyperparameters'\n"
        "print(any(file.name.endswith('.yml') for file in folder.iterdir()))\n"
        "print(len(sd_friction_env.load_pretrained('SDFriction/BeltSpeed-v0').layers))\n"
    )
    printed = run(sys.executable, "-c", program, cwd=tmp_path, PYTHONPATH=str(target)).splitlines()
    assert Path(printed[0]).is_relative_to(target)
    assert printed[1:] == [VERSION, "True", "True", "3"]
