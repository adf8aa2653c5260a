import dataclasses
import io
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import tyro
from rich.console import Console
from scipy.stats import trim_mean

import training.compare
import training.evaluate
from training import config
from training.compare import Compare, compare, judge, strongest_known
from training.config import EVALUATION_SEEDS, TUNING_SEEDS, EvaluationConfig, GaitConfig, PPOConfig, TaskConfig
from training.evaluate import load_policy
from training.metrics import measure
from training.optimal import reference
from training.plots import GAITS, POLICY, Shown, draw, median_and_range
from training.progress import Job, run_jobs
from training.report import markdown
from training.rollout import Rollout, make_envs, recorded, rollout

SNAKEBOARD = "nhenv/SnakeboardForward-v0"
TINY = TaskConfig(
    gaits={"sinusoid": GaitConfig(population=7, generations=1, starts=1)},
    ppo=PPOConfig(timesteps=512, n_envs=4, n_steps=64, batch_size=64, n_epochs=1, curve_every=1, curve_episodes=1),
    evaluation=EvaluationConfig(episodes=2, fine_substeps=2),
)


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    monkeypatch.setitem(config.CONFIGS, "Forward", TINY)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A comparison that was made once, with its options and what it printed."""
    options = Compare(env_ids=(SNAKEBOARD,), seeds=(0,), out=tmp_path_factory.mktemp("compare"), processes=2)
    console = Console(file=io.StringIO(), width=120)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(config.CONFIGS, "Forward", TINY)
        return options, compare(options, ["python", "-m", "training.compare"], console), console.file.getvalue()


def silent():
    return Console(file=io.StringIO())


def test_it_writes_numbers_a_table_and_a_figure(finished):
    options, results, printed = finished
    written = json.loads((options.out / "results.json").read_text(encoding="utf-8"))
    assert written["command"] == "python -m training.compare"
    assert written["versions"].keys() >= {"python", "torch", "stable_baselines3", "gymnasium"}
    assert os.uname().nodename not in json.dumps(written["machine"]).split('"')
    one = written["environments"][SNAKEBOARD]
    described = {"estimate", "low", "high", "mean", "std", "min", "max"}
    for controller in (one["gaits"]["sinusoid"], *one["ppo"], one["ppo_over_seeds"]):
        for metric in ("distance_m", "energy_j", "cost_of_transport", "return", "finely_integrated"):
            assert controller[metric].keys() == described
    assert one["gaits"]["sinusoid"]["episodes"] == 14
    assert one["ppo"][0]["steps"] == 512
    assert one["ppo"][0]["distance_m"]["mean"] == results["environments"][SNAKEBOARD]["ppo"][0]["distance_m"]["mean"]
    assert one["config"]["ppo"]["timesteps"] == 512
    table = (options.out / "results.md").read_text(encoding="utf-8")
    gait = one["gaits"]["sinusoid"]["distance_m"]
    for text in (table, printed):
        assert f"{gait['estimate']:.2f} [{gait['low']:.2f}, {gait['high']:.2f}]" in text
        assert "PPO, seed 0" in text
    assert "2000 resamples" in table
    image = (options.out / "SnakeboardForward-v0.png").read_bytes()
    assert image.startswith(b"\x89PNG")
    assert int.from_bytes(image[16:20], "big") >= 900  # its width


def test_results_over_seeds_are_those_of_all_their_episodes(finished):
    _, results, _ = finished
    one = results["environments"][SNAKEBOARD]
    values = []
    for policy in one["ppo"]:
        (path,) = finished[0].out.rglob(f"ppo-seed{policy['seed']}-*.zip")
        envs = recorded(SNAKEBOARD, 2)
        values.append(measure(envs, rollout(load_policy(path), envs, [EVALUATION_SEEDS, EVALUATION_SEEDS + 1])))
    pooled = np.concatenate([numbers["distance_m"] for numbers in values])
    assert one["ppo_over_seeds"]["distance_m"]["estimate"] == pytest.approx(trim_mean(pooled, 0.25), rel=1e-12)
    assert one["ppo_over_seeds"]["distance_m"]["max"] == pytest.approx(pooled.max(), rel=1e-12)
    limit = one["gaits"]["sinusoid"]["distance_m"]["estimate"]
    better = [policy["distance_m"]["estimate"] > limit for policy in one["ppo"]]
    assert one["seeds_better_than"] == {"sinusoid": sum(better)}


def test_every_controller_is_judged_again_at_a_tenth_of_the_step(finished):
    options, *_ = finished
    asked = []

    def evaluate(controller, env_id, config, seeds=EVALUATION_SEEDS, **kwargs):
        if seeds == EVALUATION_SEEDS:
            asked.append(kwargs)
        return training.evaluate.evaluate(controller, env_id, config)

    for env_id, own in ((SNAKEBOARD, 1), ("nhenv/RollerRacerForward-v0", 2)):
        assert make_envs(env_id, 1).substeps == own
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("training.compare.evaluate", evaluate)
        patch.setattr("nhenv.vector_env.LocomotionVectorEnv.substeps", 3)
        judge(SNAKEBOARD, options)
    assert asked == [{}, {"substeps": 6}] * 2  # a gait and a policy; TINY asks for half a step


def test_shares_of_the_strongest_known_and_times_to_pass_are_shown(finished):
    _, results, _ = finished
    one = results["environments"][SNAKEBOARD]
    assert one["reference"] == reference(SNAKEBOARD, drag=False)
    known = dict(one, reference=50.0, cpu_s_to_pass={"sinusoid": 7.26})
    text = markdown(dict(results, environments={SNAKEBOARD: known}))
    gait = one["gaits"]["sinusoid"]["distance_m"]["estimate"]
    (row,) = (line.split(" | ") for line in text.splitlines() if line.startswith("| sinusoid"))
    heading = next(line.split(" | ") for line in text.splitlines() if "of the strongest known |" in line)
    assert row[heading.index("of the strongest known")] == f"{100 * gait / 50:.1f} %"
    assert row[heading.index("PPO passes it after (CPU s)")] == "7.3"
    unknown = markdown(dict(results, environments={SNAKEBOARD: dict(known, reference=None)}))
    assert "| of the strongest known |" not in unknown
    (without,) = (line.split(" | ") for line in unknown.splitlines() if line.startswith("| sinusoid"))
    row.pop(heading.index("of the strongest known"))
    assert without == row


def test_a_gait_is_passed_where_the_curve_is_above_what_it_would_show_of_the_gait(finished):
    options, results, _ = finished
    asked, marks = [], []

    def evaluate(controller, env_id, config, *, seeds=EVALUATION_SEEDS, **kwargs):
        if seeds != EVALUATION_SEEDS:
            asked.append((type(controller), config.episodes, seeds, kwargs))
        return training.evaluate.evaluate(controller, env_id, config, seeds=seeds, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("training.compare.evaluate", evaluate)
        patch.setattr("training.compare.seconds_to_pass", lambda curves, metric, mark, better: marks.append(mark))
        patch.setattr("training.compare.draw", lambda *arguments: marks.append(arguments[-1]["sinusoid"]))
        judge(SNAKEBOARD, options)
    ((kind, episodes, seeds, others),) = asked
    assert (kind.__name__, episodes, seeds, others) == ("Sinusoid", 1, TUNING_SEEDS, {})
    assert marks[0] == marks[1]
    # What would be shown of a policy is what its curve shows.
    (path,) = options.out.rglob("ppo-seed0-*.zip")
    result = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))["result"]
    (best,) = (point for point in result["curve"] if point["steps"] == result["best_steps"])
    on_curve = dataclasses.replace(TINY.evaluation, episodes=1)
    _, numbers = training.evaluate.evaluate(load_policy(path), SNAKEBOARD, on_curve, seeds=TUNING_SEEDS)
    assert numbers["distance_m"].mean() == best["distance_m"]
    assert marks[0] != results["environments"][SNAKEBOARD]["gaits"]["sinusoid"]["distance_m"]["estimate"]


def test_the_strongest_known_is_asked_for_the_environment_that_is_judged(monkeypatch):
    known = {(SNAKEBOARD, False): 51.0, (SNAKEBOARD, True): 14.85}
    monkeypatch.setattr("training.compare.reference", lambda env_id, drag: known.get((env_id, drag)))
    assert strongest_known(SNAKEBOARD, {}) == 51.0
    assert strongest_known(SNAKEBOARD, {"drag": True}) == 14.85
    assert strongest_known("nhenv/SnakeboardGoal-v0", {}) is None
    assert strongest_known(SNAKEBOARD, {"dt": 0.1}) is None
    assert strongest_known(SNAKEBOARD, {"drag": {"C": 0.5}}) is None


def test_curves_are_drawn_as_their_median_and_range():
    curves = [
        [{"steps": 0, "m": 0.0}, {"steps": 10, "m": 10.0}, {"steps": 20, "m": 10.0}],
        [{"steps": 0, "m": 2.0}, {"steps": 16, "m": 2.0}],
        [{"steps": 2, "m": 4.0}, {"steps": 30, "m": 4.0}],
    ]
    places, median, low, high = median_and_range(curves, "steps", "m", 15)
    np.testing.assert_allclose(places, np.arange(2, 17))
    np.testing.assert_allclose(low, 2.0)
    np.testing.assert_allclose(median, np.clip(places, 2, 4))
    np.testing.assert_allclose(high, np.clip(places, 4, 10))


def test_seeds_are_given_as_ranges_and_the_default_is_three(tmp_path):
    assert tyro.cli(Compare, args=["--seeds", "0-9"]).seeds == tuple(range(10))
    assert tyro.cli(Compare, args=["--seeds", "4", "6-7"]).seeds == (4, 6, 7)
    assert tyro.cli(Compare, args=[]).seeds == (0, 1, 2)


def test_second_call_only_judges_and_finds_the_same(finished):
    options, results, _ = finished
    assert options.jobs() == []
    again = compare(options, [], silent())
    for controller in ("gaits", "ppo", "ppo_over_seeds"):
        assert again["environments"][SNAKEBOARD][controller] == results["environments"][SNAKEBOARD][controller]


def test_changed_settings_invalidate_what_they_concern(finished, monkeypatch):
    options, *_ = finished
    longer = dataclasses.replace(options, timesteps=1024)
    more = dataclasses.replace(options, seeds=(0, 1))
    assert [job.label for job in longer.jobs()] == ["SnakeboardForward-v0 PPO seed 0"]
    assert [job.label for job in more.jobs()] == ["SnakeboardForward-v0 PPO seed 1"]
    gaits = TINY.gaits | {"second": dataclasses.replace(TINY.gaits["sinusoid"], seed=1)}
    monkeypatch.setitem(config.CONFIGS, "Forward", dataclasses.replace(TINY, gaits=gaits))
    assert [job.label for job in options.jobs()] == ["SnakeboardForward-v0 second"]
    judged = dataclasses.replace(TINY, evaluation=EvaluationConfig(episodes=3))
    monkeypatch.setitem(config.CONFIGS, "Forward", judged)
    assert options.jobs() == []


def test_drag_is_another_experiment(finished):
    options, *_ = finished
    dragged = dataclasses.replace(options, drag=True)
    config = dragged.config(SNAKEBOARD)
    for part in (config.gaits["sinusoid"], config.ppo, config.evaluation):
        assert part.env_kwargs == {"drag": True}
    assert len(dragged.jobs()) == 2
    assert options.jobs() == []


def test_a_sprint_trains_with_other_settings(monkeypatch):
    other = dataclasses.replace(TINY.ppo, gamma=0.5)
    monkeypatch.setitem(config.CONFIGS, "Forward", dataclasses.replace(TINY, sprint_of={"snakeboard, drag": other}))
    usual = Compare(env_ids=(SNAKEBOARD,), drag=True).config(SNAKEBOARD)
    sprint = Compare(env_ids=(SNAKEBOARD,), drag=True, sprint=True).config(SNAKEBOARD)
    assert sprint == dataclasses.replace(usual, ppo=dataclasses.replace(usual.ppo, gamma=0.5))


def test_options_are_checked():
    with pytest.raises(ValueError, match="leave --sprint out"):
        Compare(sprint=True)
    with pytest.raises(ValueError, match="Did you mean 'nhenv/SnakeboardForward-v0'"):
        Compare(env_ids=("nhenv/SnakeBoardForward-v0",))
    with pytest.raises(ValueError, match="different numbers"):
        Compare(seeds=(1, 1))
    with pytest.raises(ValueError, match="seed of a run"):
        Compare(seeds=(-1,))


def test_defaults_take_every_environment_with_settings():
    assert set(Compare().env_ids) == {"nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0"}


@pytest.mark.slow
def test_failure_of_a_job_is_told(tmp_path):
    with pytest.raises(ValueError, match="unknown environment 'nhenv/Nothing-v0'"):
        run_jobs([Job("x", _fail, ())], 1, silent())


def _fail(report):
    config.check_env_id("nhenv/Nothing-v0")


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_ctrl_c_keeps_what_is_done(tmp_path):
    command = [sys.executable, "-m", "training.train", "--env-id", SNAKEBOARD, "--out", str(tmp_path)]
    with subprocess.Popen(
        command, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True
    ) as process:
        deadline = time.monotonic() + 120
        while not list(tmp_path.rglob("*.checkpoint")):
            assert process.poll() is None
            assert time.monotonic() < deadline
            time.sleep(0.1)
        os.killpg(process.pid, signal.SIGINT)  # as a terminal does, to every process
        _, errors = process.communicate(timeout=60)
    assert process.returncode == 1
    assert b"interrupted; the same command goes on" in errors
    (checkpoint,) = tmp_path.rglob("*.checkpoint")
    assert checkpoint.stat().st_size > 0


@pytest.mark.parametrize("best", [0, 1])
def test_the_best_gait_is_drawn_beside_the_policy(finished, monkeypatch, best):
    options, *_ = finished
    gait = TINY.gaits["sinusoid"]
    monkeypatch.setitem(config.CONFIGS, "Forward", dataclasses.replace(TINY, gaits={"one": gait, "other": gait}))
    honest, judged, beside = training.compare._judged, [], []

    def flatter(*arguments):
        episodes, report, scores = honest(*arguments)
        judged.append(report)
        if len(judged) == best + 1:
            report["distance_m"] = dict(report["distance_m"], estimate=report["distance_m"]["estimate"] + 1)
        return episodes, report, scores

    monkeypatch.setattr("training.compare._judged", flatter)
    monkeypatch.setattr("training.compare.draw", lambda *arguments: beside.append(arguments[4]))
    judge(SNAKEBOARD, options)
    assert beside == [best]


CURVE = [{"steps": steps, "cpu_s": steps, "distance_m": way, "success": way} for steps, way in ((0, -3.0), (10, 1.0))]


@pytest.fixture
def figures(monkeypatch):
    """Axes of the figures that are drawn, by the label of what they show up or by their title."""
    found = {}

    def keep(figure, *_, **__):
        found.update({ax.get_title() or ax.get_ylabel(): ax for ax in figure.axes})

    monkeypatch.setattr("matplotlib.figure.Figure.savefig", keep)
    return found


def episodes(steps, longest, envs, targets=None):
    """Two episodes of random states, the first as long as this."""
    q = np.random.default_rng(steps).normal(size=(2, longest + 1, 5))
    torques, v = np.zeros((2, longest, 2)), np.zeros((2, longest + 1, 3))
    return Rollout(np.zeros(2), q, torques, v, np.array([steps, longest]), targets or {}, {})


def test_a_figure_shows_each_episode_up_to_its_own_end(tmp_path, figures):
    """Episodes of a goal do not last equally long, and of a thousand the first is seldom the longest."""
    envs = make_envs(SNAKEBOARD, 1, backend="numpy")
    two = [Shown("gait", GAITS[0], episodes(20, 50, envs)), Shown("policy", POLICY, episodes(30, 90, envs))]
    draw(tmp_path / "figure.png", "title", envs, two, 0, [CURVE], {"gait": 1.0})
    last = [max(line.get_xdata().max() for line in ax.lines) for title, ax in figures.items() if "last 4 s" in title]
    assert last == pytest.approx([20 * envs.dt, 30 * envs.dt])
    assert [len(line.get_xdata()) - 1 for line in figures["heading (rad)"].lines] == [20, 30]
    x = two[1].episodes.q[0, :31, 0]
    velocity = figures["velocity along x (m/s)"].patches[1].get_data()
    np.testing.assert_allclose(velocity.values, np.diff(x) / envs.dt)


def test_a_figure_shows_the_target_and_the_way_to_it(tmp_path, figures):
    envs = make_envs("nhenv/SnakeboardTurn-v0", 1, backend="numpy")
    targets = {"turn_size": [1.0], "turn_side": [1.0], "target_heading": [2.0], "start_x": [0.3], "start_y": [-0.1]}
    targets = {name: np.array(values) for name, values in targets.items()}
    shown = [Shown(name, GAITS[0], episodes(160, 160, envs, targets)) for name in ("weak", "strong", "policy")]
    draw(tmp_path / "figure.png", "title", envs, shown, 1, [CURVE], {"weak": 0.2, "strong": 0.8})
    assert {"strong, first 4 s", "policy, first 4 s"} < figures.keys()
    assert max(line.get_xdata().max() for line in figures["policy, first 4 s"].lines) == pytest.approx(4.0)
    (circle,) = (patch for patch in figures["y (m)"].patches if patch.get_label() == "target")
    assert (*circle.center, circle.radius) == (0.3, -0.1, 0.15)
    assert figures["heading (rad)"].lines[-1].get_ydata()[0] == 2.0
    way = figures["way to the target (m)"].lines[1]
    q = shown[-1].episodes.q[0]
    np.testing.assert_allclose(way.get_ydata(), np.hypot(q[:, 0] - 0.3, q[:, 1] + 0.1))


@pytest.mark.parametrize(
    ("env_id", "shown"), [(SNAKEBOARD, (-0.8, None)), ("nhenv/SnakeboardVelocity-v0", (None, 2.8))]
)
def test_a_curve_is_shown_where_the_gaits_are(tmp_path, figures, env_id, shown):
    """As far below the worst of all (above it, where less is better) as the best is from it."""
    envs = make_envs(env_id, 1, backend="numpy")
    two = [Shown("gait", GAITS[0], episodes(20, 50, envs)), Shown("policy", POLICY, episodes(30, 90, envs))]
    metric = "distance_m" if env_id == SNAKEBOARD else "speed_error_mps"
    values = (-3.0, 1.0) if env_id == SNAKEBOARD else (5.0, 1.0)
    curve = [{"steps": i, "cpu_s": i, metric: value} for i, value in enumerate(values)]
    draw(tmp_path / "figure.png", "title", envs, two, 0, [curve], {"worse": 0.1, "gait": 0.7, "other": 1.9})
    (ax,) = (ax for name, ax in figures.items() if name in ("distance (m)", "speed error (m/s)"))
    low, high = ax.get_ylim()
    if shown[0] is not None:
        assert low == pytest.approx(2 * 0.1 - 1.9)
    else:
        assert high == pytest.approx(2 * 1.9 - 0.1)
