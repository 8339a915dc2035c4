"""The documentation: it builds without a warning, needs no network, and all of its Python runs as printed."""

import importlib.util
import inspect
import os
import re
import shlex
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch

import sd_friction_env
from scripts import cleanrl_ppo
from sd_friction_env import Task
from sd_friction_env.cli import main
from sd_friction_env.control.policies import load_policy
from sd_friction_env.environments.wrappers import scaled_reward
from sd_friction_env.learning import evaluation

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
ONE_THREAD = {**os.environ, "OMP_NUM_THREADS": "1", "NO_MKDOCS_2_WARNING": "1", "MPLBACKEND": "agg"}


def module_in_docs(name):
    specification = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


hooks, agents_table = module_in_docs("hooks"), module_in_docs("renew_agents_table")
PAGES = sorted(path.relative_to(DOCS).as_posix() for path in DOCS.rglob("*.md"))


def code_of(page, language="python"):
    """Return a page's blocks as one program, each line where it stands in the page."""
    program, inside = [], False
    for line in hooks.expanded((DOCS / page).read_text(encoding="utf-8")).splitlines():
        if line.startswith("```"):
            inside, line = line == f"```{language}", ""
        program.append(line if inside else "")
    return "\n".join(program)


WITH_PYTHON = [page for page in PAGES if code_of(page).strip()]
COMMANDS = [
    (page, command)
    for page in PAGES
    for command in re.sub(r"\\\n *", "", code_of(page, "sh")).splitlines()
    if command.strip() and not command.startswith("#")
]


# The pages ------------------------------------------------------------------------------------------------------------


SLOW_PAGES = ("howto/own_law.md", "howto/sb3.md", "tutorial.md")


@pytest.mark.parametrize(
    "page", [pytest.param(page, marks=[pytest.mark.slow] if page in SLOW_PAGES else []) for page in WITH_PYTHON]
)
def test_the_python_of_a_page_runs_as_printed(page, tmp_path):
    program = f"exec(compile({code_of(page)!r}, {page!r}, 'exec'))"
    run = subprocess.run(
        [sys.executable, "-W", "error", "-c", program],
        check=False,
        cwd=tmp_path,
        env=ONE_THREAD,
        capture_output=True,
        text=True,
        timeout=600,
    )
    assert run.returncode == 0, run.stderr


def test_the_pages_that_teach_have_python_in_them():
    assert {"index.md", "tutorial.md", "environment.md"} <= set(WITH_PYTHON)
    assert {f"howto/{path.name}" for path in (DOCS / "howto").glob("*.md")} <= set(WITH_PYTHON)


# What takes minutes, serves until it is stopped, or needs a run that another command makes: only its options are read.
NOT_RUN = re.compile(
    r"sd-friction (train|tune|tune-classical|optimum|report|explore|evaluate .*gradient-mpc|evaluate runs/|"
    r"export runs/|.*runs/|.*mine)"
)
OURS = [pair for pair in COMMANDS if pair[1].startswith("sd-friction ")]


@pytest.mark.parametrize(("page", "command"), [pair for pair in OURS if NOT_RUN.match(pair[1])])
def test_the_long_commands_of_a_page_take_the_options_that_it_shows(page, command):
    words = shlex.split(command.replace("$SLURM_ARRAY_TASK_ID", "1"))[1:]
    assert main.parser(words[:1]).parse_args(words).command == words[0]


@pytest.mark.slow
@pytest.mark.parametrize(("page", "command"), [pair for pair in OURS if not NOT_RUN.match(pair[1])])
def test_the_commands_of_a_page_run_as_printed(page, command, tmp_path):
    arguments = [sys.executable, "-m", "sd_friction_env", *command.split()[1:]]
    subprocess.run(arguments, cwd=tmp_path, env=ONE_THREAD, check=True, capture_output=True, timeout=600)


@pytest.mark.parametrize(("page", "command"), [pair for pair in COMMANDS if pair[1].startswith("python scripts/")])
def test_the_scripts_that_a_page_names_take_the_options_that_it_shows(page, command):
    _, script, *arguments = command.split()
    shown = subprocess.run(
        [sys.executable, script, "--help"], cwd=ROOT, env=ONE_THREAD, check=True, capture_output=True, text=True
    ).stdout
    options = {argument for argument in arguments if argument.startswith("--")}
    assert {option for option in options if not re.search(rf"^ +{option}\b", shown, re.M)} == set()


def test_every_command_of_the_pages_is_of_a_kind_that_is_checked():
    known = ("sd-friction ", "python scripts/", "python -m rl_zoo3.train ", "FOLDER=$(sd-friction hyperparameters)")
    install = ('python -m pip install -e ".[train,plot]"',)
    assert [pair for pair in COMMANDS if not pair[1].startswith(known) and pair[1] not in install] == []


def test_rl_zoo_knows_the_options_that_its_page_shows():
    train = importlib.util.find_spec("rl_zoo3").submodule_search_locations[0]
    source = (Path(train) / "train.py").read_text(encoding="utf-8")
    shown = {word for _, command in COMMANDS if "rl_zoo3" in command for word in command.split() if word[0] == "-"}
    assert {option for option in shown - {"-m"} if f'"{option}"' not in source} == set()


def test_the_environment_page_names_all_that_info_holds():
    section = (DOCS / "environment.md").read_text(encoding="utf-8").partition("## What info holds")[2]
    table = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    env = gym.make("SDFriction/Force-v0")
    env.reset(seed=0)
    told = env.step(np.zeros(1, np.float32))[4]
    assert set(re.findall(r"`(\w+)`", " ".join(table))) == set(told)


def test_the_table_of_agents_is_current():
    page = agents_table.PAGE.read_text(encoding="utf-8")
    assert page == agents_table.renewed(page)
    runs = {path.name for path in (ROOT / "agents" / "pretrained").iterdir()}
    assert runs == set(re.findall(r"^\| ([\w-]+) \| `python scripts/train.py", page, re.M))


def test_links_of_the_readme_are_absolute_where_the_repository_is_known():
    standalone = module_in_docs("long_description").standalone
    page = "![a curve](figures/a.png) [Docs](docs/a.md) [below](#below) [Gymnasium](https://gymnasium.farama.org)"
    kept = "[below](#below) [Gymnasium](https://gymnasium.farama.org)"
    assert standalone(page) == f" Docs {kept}"
    place = "https://example.org/us/it"
    assert (
        standalone(page, place)
        == f"![a curve]({place}/raw/main/figures/a.png) [Docs]({place}/blob/main/docs/a.md) {kept}"
    )


def test_the_argument_tables_show_every_default():
    table = hooks.argument_table("Task")
    for name, parameter in inspect.signature(Task).parameters.items():
        default = {} if name in ("randomise", "drift") else parameter.default
        assert f"| `{name}` | `{default!r}` | " in table


# The site -------------------------------------------------------------------------------------------------------------


class Links(HTMLParser):
    """What a page refers to, and what it loads."""

    def __init__(self):
        super().__init__()
        self.targets, self.loaded = [], []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        place = given.get("src") or given.get("href")
        if place is not None and tag in ("img", "script", "link", "iframe"):
            self.loaded.append(place)
        elif place is not None:
            self.targets.append(place)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder)]
    run = subprocess.run(command, check=False, cwd=ROOT, env=ONE_THREAD, capture_output=True, text=True, timeout=900)
    assert run.returncode == 0, run.stderr
    assert "WARNING" not in run.stderr
    return folder


@pytest.mark.slow
def test_the_site_has_every_page_and_every_module(site):
    expected = {page.replace(".md", ".html") for page in PAGES} | {"tour.html", "api/index.html"}
    expected |= {name.replace(".md", ".html") for name in hooks.BORROWED}
    expected |= {f"api/{module}.html" for module in hooks.modules()}
    assert {page for page in expected if not (site / page).is_file()} == set()
    assert not list(site.rglob("*.py"))


@pytest.mark.slow
def test_the_site_loads_nothing_from_elsewhere_and_has_no_dead_link(site):
    for page in site.rglob("*.html"):
        if page.name == "404.html":  # knows only its place on a server
            continue
        links = Links()
        links.feed(page.read_text(encoding="utf-8"))
        assert [place for place in links.loaded if re.match(r"(https?:)?//", place)] == []
        for place in links.targets + links.loaded:
            path = place.partition("#")[0]
            if path and not re.match(r"[a-z]+:", path):
                assert (page.parent / path).exists(), f"{page.name}: {place}"


@pytest.mark.slow
def test_the_api_has_an_entry_with_its_own_type_for_each_name_that_a_docstring_describes(site):
    pages = sorted((site / "api").glob("sd_friction_env.physics.orbits*.html"))
    page = "".join(path.read_text(encoding="utf-8") for path in pages)
    for name, kind in [
        ("eigenvalues", "tuple"),
        ("period", "float"),
        ("angular_frequency", "float"),
        ("sticks", "int"),
    ]:
        assert re.search(rf">{name}</span></code></b>\s*\(<code><span title=\"{kind}\">", page), name


@pytest.mark.slow
def test_the_overview_of_the_api_names_all_that_the_package_offers_at_its_top_level(site):
    page = (site / "api" / "index.html").read_text(encoding="utf-8")
    offered = set(sd_friction_env.__all__) - {"__version__", "ENVIRONMENT_IDS"}
    assert {name for name in offered if f"<code>{name}</code></a>" not in page} == set()


@pytest.mark.slow
def test_formulas_are_typeset_without_a_server(site):
    page = (site / "environment.html").read_text(encoding="utf-8")
    assert page.count('<div class="arithmatex">') >= 4
    assert 'src="katex/katex.min.js"' in page


@pytest.mark.slow
def test_the_api_shows_docstrings_with_links(site):
    page = (site / "api" / "sd_friction_env.physics.curves.html").read_text(encoding="utf-8")
    assert "Return all attractors at each belt speed" in page
    assert 'href="#sd_friction_env.physics.curves.amplitude_curve"' in page
    for path in site.rglob("*.html"):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r":(attr|class|func|meth|mod):", text), path.name
        assert "<autoref" not in text, path.name


@pytest.mark.slow
def test_the_environment_page_is_the_docstring_in_gymnasiums_form(site):
    page = (site / "environment.html").read_text(encoding="utf-8")
    headings = [re.sub(r"<.*?>|&para;", "", heading) for heading in re.findall(r"<h2.*?>(.*?)</h2>", page, re.S)]
    wanted = [
        "Description",
        "Action Space",
        "Observation Space",
        "Rewards",
        "Starting State",
        "Episode End",
        "Arguments",
    ]
    assert [heading for heading in headings if heading in [*wanted, "Version History"]][:8] == [
        *wanted,
        "Version History",
    ]
    assert all(f"<code>{env_id}</code>" in page for env_id in sd_friction_env.ENVIRONMENT_IDS)


# The notebook ---------------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_notebook_runs_and_shows_what_is_kept(monkeypatch):
    monkeypatch.setenv("TOUR_TRAINING_STEPS", "4096")
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    renew = module_in_docs("renew_notebook")
    kept, now = renew.read(), renew.executed()
    assert kept.cells
    printed = 0
    for old, new in zip(kept.cells, now.cells, strict=True):
        if "model.learn" in old.source:  # from here on the budget shows
            break
        # Output may be split into several pieces; messages about compilation go to stderr.
        told = [[o for o in cell.get("outputs", []) if o.get("name") != "stderr"] for cell in (old, new)]
        before, after = ("".join(output.get("text", "") for output in outputs) for outputs in told)
        assert before == after
        kinds = [{output.output_type for output in outputs} for outputs in told]
        assert kinds[0] == kinds[1]
        printed += bool(before)
    assert printed >= 2
    assert sum("image/png" in output.get("data", {}) for cell in now.cells for output in cell.get("outputs", [])) == 5


# PPO in CleanRL's manner ----------------------------------------------------------------------------------------------

TINY = ["--num-envs", "4", "--num-steps", "25", "--total-timesteps", "300", "--update-epochs", "2"]


def trained(*arguments):
    return cleanrl_ppo.train(cleanrl_ppo.make_parser().parse_args([*TINY, *arguments]), progress=False)


def same_weights(a, b):
    pairs = zip(sum(a.layers, ()), sum(b.layers, ()), strict=True)
    return all(np.array_equal(weights, others) for weights, others in pairs)


@pytest.mark.parametrize("env_id", ["SDFriction/Force-v0", "SDFriction/BeltSpeedSensed-v0"])
def test_the_native_batch_and_gymnasiums_train_to_the_same_bits(env_id):
    two = ["--env-id", env_id, "--num-envs", "2", "--num-steps", "300", "--total-timesteps", "1800"]
    native, sync = (trained(*two, "--vector", kind) for kind in ("native", "sync"))
    assert len(native.metadata["returns"]) == 2  # episodes end in the middle of a rollout
    assert native.metadata["returns"] == sync.metadata["returns"]
    assert same_weights(native, sync)
    assert not same_weights(native, trained(*two, "--seed", "1"))


def test_an_episode_cut_short_goes_on_in_the_value_of_its_own_last_observation(monkeypatch):
    rollouts = []
    advantages = cleanrl_ppo.generalised_advantages

    def seen(*arguments):
        rollouts.append([part.clone() for part in arguments[:4]])
        return advantages(*arguments)

    monkeypatch.setattr(cleanrl_ppo, "generalised_advantages", seen)
    trained("--num-envs", "2", "--num-steps", "300", "--total-timesteps", "1200")
    _, values, next_values, over = rollouts[-1]
    ends = over[:-1] > 0.0
    assert int(ends.sum()) == 2
    assert torch.allclose(next_values[:-1][~ends], values[1:][~ends], atol=1e-6)
    assert (next_values[:-1][ends] != 0.0).all()
    assert ((next_values[:-1][ends] - values[1:][ends]).abs() > 1e-3).all()  # not the next episode's first


def test_advantages_are_the_discounted_sums_that_define_them():
    rng = np.random.default_rng(3)
    rewards, values, next_values = (torch.from_numpy(rng.normal(size=(12, 3))) for _ in range(3))
    over = torch.from_numpy((rng.random((12, 3)) < 0.3).astype(float))
    gamma, gae_lambda = 0.9, 0.7
    found = cleanrl_ppo.generalised_advantages(rewards, values, next_values, over, gamma, gae_lambda)
    for i in range(3):
        for t in range(12):
            wanted = 0.0
            for k in range(t, 12):
                surprise = rewards[k, i] + gamma * next_values[k, i] - values[k, i]
                wanted += (gamma * gae_lambda) ** (k - t) * float(surprise)
                if over[k, i]:
                    break
            assert float(found[t, i]) == pytest.approx(wanted, abs=1e-12)


def test_sixty_thousand_steps_calm_the_machine():
    """The untrained network is as good as passive; half of that cost is gone by then (measured: two thirds)."""
    options = ["--num-envs", "16", "--num-steps", "125", "--total-timesteps", "60000", "--log-std-end", "-1"]
    policy = cleanrl_ppo.train(cleanrl_ppo.make_parser().parse_args(options), progress=False)
    assert policy.metadata["steps"] == 60_000
    episodes = policy.metadata["returns"]
    assert len(episodes) == 16 * (60_000 // 16 // 500)
    seeds = evaluation.VALIDATION_SEEDS[:20]
    passive = evaluation.passive_episodes("SDFriction/Force-v0", seeds).reward.sum(axis=1).mean()
    reached = evaluation.evaluate(policy, "SDFriction/Force-v0", seeds)["return"].mean()
    assert reached > 0.5 * passive


def test_the_returns_it_tells_are_the_environments_own(monkeypatch):
    """Not the shaped rewards: with another shape the first episodes, before anything is learnt, tell the same."""
    long = ["--num-steps", "500", "--total-timesteps", "2000"]
    plain, shaped = trained(*long), trained(*long, "--reward-scale", "3", "--reward-power", "1")
    assert plain.metadata["returns"] == shaped.metadata["returns"]
    assert len(plain.metadata["returns"]) == 4
    assert max(plain.metadata["returns"]) < -100.0
    assert scaled_reward(-4.0, 0.1, 0.5) == pytest.approx(-0.2)


def test_the_script_writes_a_policy_that_can_be_used(tmp_path, capsys):
    path = tmp_path / "agent.npz"
    assert cleanrl_ppo.main([*TINY, "--out", str(path)]) == 0
    policy = load_policy(path)
    assert policy.metadata["env_id"] == "SDFriction/Force-v0"
    assert policy.observation_size == 2
    assert "300 steps" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--num-envs", "0"], "--num-envs must be in [1, 65536], got 0"),
        (["--gamma", "1.5"], "--gamma must be in [0, 1], got 1.5"),
        (["--gamma", "nan"], "--gamma must be in [0, 1], got nan"),
        (["--num-minibatches", "51"], "--num-minibatches must leave 2 of the 100 steps to each, got 51"),
        (["--out", "agent.zip"], "--out must end in .npz, got 'agent.zip'"),
        (["--out", "nowhere/agent.npz"], "--out must lie in a folder that can be written to, got 'nowhere/agent.npz'"),
        (["--env-id", "CartPole-v1"], "argument --env-id: invalid choice: 'CartPole-v1'"),
    ],
)
def test_a_bad_option_is_one_line(arguments, said, capsys):
    with pytest.raises(SystemExit) as stop:
        cleanrl_ppo.main([*TINY, *arguments])
    message = capsys.readouterr().err
    assert stop.value.code == 2
    assert said in message
    assert len(message.splitlines()) == 1


def test_an_interrupt_writes_nothing(tmp_path, monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(cleanrl_ppo, "train", interrupted)
    assert cleanrl_ppo.main([*TINY, "--out", str(tmp_path / "agent.npz")]) == 130
    assert "interrupted; nothing was written" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
