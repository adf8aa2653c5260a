"""Every setting of an experiment, as frozen data: one `TaskConfig` for each task."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import partial
from typing import Any, Literal, get_args

import gymnasium as gym

import nhenv
from mechanics.expressions import unknown_name
from nhenv import tasks
from nhenv.registration import as_mechanism

__all__ = [
    "COMPARED",
    "CONFIGS",
    "EVALUATION_SEEDS",
    "SEEDS_PER_RUN",
    "TUNING_SEEDS",
    "EvaluationConfig",
    "GaitConfig",
    "LawConfig",
    "PPOConfig",
    "SearchConfig",
    "TaskConfig",
    "TorqueConfig",
    "check_env_id",
    "for_env",
    "quick",
    "task_name",
    "training_seed",
    "within",
]

# Three ranges of environment seeds that never meet: nobody is judged on starts that it was fitted to.
SEEDS_PER_RUN = 1_000  # run s trains on the seeds from s * SEEDS_PER_RUN
TUNING_SEEDS = 10_000_000  # where gaits are tuned and learning curves are drawn
EVALUATION_SEEDS = 20_000_000

Activation = Literal["tanh", "leaky_relu"]


@dataclass(frozen=True, kw_only=True)
class SearchConfig:
    """Tuning by differential evolution: the budget that every family of gaits and laws has.

    Attributes:
        env_kwargs: arguments of the environment in which it is tuned, as plain data, such as {"drag": True}.
        population: candidates in a generation, rounded down to a multiple of the number of parameters.
        generations: generations after the first, which is a Latin hypercube.
        starts: episodes on which each candidate is tried.
        seed: seed of the search.
    """

    env_kwargs: dict[str, Any] = field(default_factory=dict)
    population: int = 64
    generations: int = 100
    starts: int = 4
    seed: int = 0

    @property
    def label(self) -> str:
        """What it is called where nothing else tells."""
        raise NotImplementedError

    def fits(self, mechanism: str) -> bool:
        """Whether the mechanism of this name can be driven so."""
        return True


@dataclass(frozen=True, kw_only=True)
class GaitConfig(SearchConfig):
    """Sinusoidal gaits by computed torque.

    What is fed back are expressions in what is observed, by label and in SI units, and in `forward` (+1 or -1).

    Attributes:
        steered: whether amplitudes and frequency change over the episode, and the joints with stops are turned further.
        steered_by: what turns them in a steered gait, times a tuned gain.
        steering: largest of these gains, rad.
        cyclic_by: what scales the amplitudes of the joints without stops, times a tuned gain, from -1 to 1; None to
            leave them.
        limited_by: the same for the joints with stops.
        gain: largest of the gains of these two.
        cyclic_ratio: frequency of the joints without stops over that of the joints with stops.
        frequency: smallest and largest angular frequency of the joints with stops, rad/s.
        cyclic_amplitude: largest amplitude of a joint without stops, rad. One with stops reaches its stop.
        damping: smallest and largest kd of the feedback, 1/s. A torque held for dt needs kd * dt < 2.
    """

    steered: bool = False
    steered_by: str = "sin_heading"
    steering: float = 2.0
    cyclic_by: str | None = None
    limited_by: str | None = None
    gain: float = 5.0
    cyclic_ratio: float = 1.0
    frequency: tuple[float, float] = (1.0, 30.0)
    cyclic_amplitude: float = 12.0
    damping: tuple[float, float] = (2.0, 38.0)

    @property
    def label(self) -> str:
        """What it is called where nothing else tells."""
        return "steered sinusoid" if self.steered else "sinusoid"


@dataclass(frozen=True, kw_only=True)
class TorqueConfig(SearchConfig):
    """Torques that are sinusoids, in open loop.

    Attributes:
        cyclic_ratio: frequency of the torques on joints without stops over that on joints with stops.
        frequency: smallest and largest angular frequency of the torques on joints with stops, rad/s.
    """

    cyclic_ratio: float = 1.0
    frequency: tuple[float, float] = (1.0, 30.0)

    @property
    def label(self) -> str:
        """What it is called where nothing else tells."""
        return "torque sinusoid"


@dataclass(frozen=True, kw_only=True)
class LawConfig(SearchConfig):
    """A law in closed form, of `training.laws`.

    Attributes:
        mechanism: name of the mechanism that it is for.
        law: name of the law.
    """

    mechanism: str
    law: str

    @property
    def label(self) -> str:
        """What it is called where nothing else tells."""
        return self.law

    def fits(self, mechanism: str) -> bool:
        """Whether the mechanism of this name can be driven so."""
        return mechanism == self.mechanism


@dataclass(frozen=True, kw_only=True)
class PPOConfig:
    """PPO with Stable-Baselines3.

    Attributes:
        env_kwargs: arguments of the environment in which it learns, as plain data.
        timesteps: environment steps of a run, over all environments.
        n_envs: environments side by side.
        n_steps: steps of each environment between updates. The number of updates counts, not of steps.
        batch_size: transitions in a minibatch.
        n_epochs: passes over a rollout.
        learning_rate: at the beginning and at the end, linear in between. 1e-3 to begin with costs metres.
        gamma: discount of a step.
        gae_lambda: λ of the generalized advantage estimate.
        clip_range: clip of the probability ratio.
        target_kl: an update stops early above 1.5 times this divergence.
        entropy: weight of the policy's entropy, at the beginning and at the end, linear in between.
        levels: the policy chooses each action from this many values, evenly from -1 to 1; 0 for a normal distribution.
        log_std: initial logarithm of the policy's standard deviation, in actions.
        reward_scale: what rewards are multiplied by. Value function and policy share a limit on the gradient, and
            returns of hundreds leave nothing of it to the policy.
        observation_scale: label of an observation -> what it is multiplied by for the networks; 1 where there is none.
        start_energy: J; episodes begin in motion, with up to this much, ever fewer of them; 0 for none.
        start_offset: m; these begin up to this far, along x and along y, from where their targets are drawn.
        start_share: part of the training after which all begin at rest; beyond 1, some always begin in motion.
        hidden: units of each hidden layer; policy and value function share none.
        activation: of these layers, "tanh" or "leaky_relu", which is quicker and has a slope of 0.01 below zero.
        curve_every: updates between two points of the learning curve.
        curve_episodes: episodes of the deterministic policy behind each point.
        checkpoint_every: updates between two checkpoints.
    """

    env_kwargs: dict[str, Any] = field(default_factory=dict)
    timesteps: int = 3_000_000
    n_envs: int = 64
    n_steps: int = 64
    batch_size: int = 1024
    n_epochs: int = 10
    learning_rate: tuple[float, float] = (3e-3, 3e-4)
    gamma: float = 0.999
    gae_lambda: float = 0.95
    clip_range: float = 0.2
    target_kl: float = 0.03
    entropy: tuple[float, float] = (0.0, 0.0)
    levels: int = 0
    log_std: float = 0.0
    reward_scale: float = 1.0
    observation_scale: dict[str, float] = field(default_factory=dict)
    start_energy: float = 0.0
    start_offset: float = 0.0
    start_share: float = 0.8
    hidden: tuple[int, ...] = (64, 64)
    activation: Activation = "tanh"
    curve_every: int = 10
    curve_episodes: int = 8
    checkpoint_every: int = 20

    def __post_init__(self) -> None:
        if self.activation not in get_args(Activation):
            raise ValueError(unknown_name("activation", self.activation, get_args(Activation)))
        if self.levels < 0 or self.levels == 1:
            raise ValueError(f"levels must be 0 or at least 2, got {self.levels}")


@dataclass(frozen=True, kw_only=True)
class EvaluationConfig:
    """How a finished controller is judged.

    Attributes:
        env_kwargs: arguments of the environment in which it is judged, as plain data.
        episodes: episodes, the same starts for every controller.
        fine_substeps: steps of the integrator for each that it takes by itself, in a second opinion: none shall win on
            its error.
    """

    env_kwargs: dict[str, Any] = field(default_factory=dict)
    episodes: int = 100
    fine_substeps: int = 10


@dataclass(frozen=True, kw_only=True)
class TaskConfig:
    """Settings of every part of an experiment on one task.

    Attributes:
        gaits: by name, with equal budgets; each where it fits the mechanism.
        ppo: what trains the policy.
        ppo_of: mechanism, or mechanism and ", drag" where its drag acts -> what trains its policy instead.
        sprint_of: the same -> what passes the steered gait soonest, for who would rather wait seconds than minutes.
        evaluation: what judges both.
    """

    gaits: dict[str, SearchConfig] = field(
        default_factory=lambda: {
            "sinusoid": GaitConfig(),
            "steered sinusoid": GaitConfig(steered=True),
            "torque sinusoid": TorqueConfig(),
            "bang-bang": LawConfig(mechanism="snakeboard", law="bang-bang"),
            "charge, then go": LawConfig(mechanism="snakeboard", law="charge, then go"),
            "chirped steering": LawConfig(mechanism="snakeboard", law="chirped steering"),
            "relay": LawConfig(mechanism="roller_racer", law="relay"),
        }
    )
    ppo: PPOConfig = field(default_factory=PPOConfig)
    ppo_of: dict[str, PPOConfig] = field(default_factory=dict)
    sprint_of: dict[str, PPOConfig] = field(default_factory=dict)
    evaluation: EvaluationConfig = field(default_factory=EvaluationConfig)


# Targets differ more than starts at rest do: it takes more of them to tell who is better.
_JUDGED_OFTEN = EvaluationConfig(episodes=1000)
_VARIED = PPOConfig(
    timesteps=1_000_000, gamma=0.99, reward_scale=0.1, entropy=(0.01, 0.0), start_energy=4.0, curve_episodes=64
)
_VELOCITY = dataclasses.replace(_VARIED, timesteps=3_000_000, reward_scale=0.05)
_TURN = dataclasses.replace(_VARIED, timesteps=5_000_000, entropy=(0.04, 0.0), start_offset=0.3)
_gait = partial(GaitConfig, starts=16)

CONFIGS: dict[str, TaskConfig] = {
    "Forward": TaskConfig(
        ppo=PPOConfig(reward_scale=0.05, entropy=(0.02, 0.0)),
        # What lasts longer is worth more: without drag rewards and energies are larger.
        ppo_of={
            "snakeboard": PPOConfig(
                learning_rate=(3e-3, 1e-4),
                gamma=0.9995,
                reward_scale=0.02,
                entropy=(0.006, 0.0),
                levels=3,
                observation_scale={"phi": 5.0, "phi_dot": 4.0, "sin_heading": 4.0},  # which are small once it goes
                start_energy=150.0,
            ),
            "snakeboard, drag": PPOConfig(
                timesteps=3_500_000, reward_scale=0.05, entropy=(0.02, 0.0), start_energy=30.0, activation="leaky_relu"
            ),
            "roller_racer": PPOConfig(
                timesteps=1_500_000, reward_scale=0.02, entropy=(0.005, 0.0), levels=3, start_energy=20.0
            ),
            "roller_racer, drag": PPOConfig(reward_scale=0.05, entropy=(0.06, 0.0), start_energy=8.0),
        },
        # Of random searches on tuning seeds: large steps, few levels, for the snakeboard half as many environments.
        sprint_of={
            "snakeboard, drag": PPOConfig(
                timesteps=500_000,
                n_envs=32,
                learning_rate=(4e-3, 3e-4),
                gamma=0.995,
                gae_lambda=0.93,
                reward_scale=0.05,
                entropy=(0.01, 0.0),
                levels=3,
                start_energy=30.0,
                start_share=0.5,
                activation="leaky_relu",
                curve_every=16,
            ),
            "roller_racer, drag": PPOConfig(
                timesteps=140_000,
                n_epochs=6,
                learning_rate=(5e-3, 3e-4),
                gamma=0.97,
                reward_scale=0.05,
                entropy=(0.01, 0.0),
                levels=3,
                hidden=(32, 32),
                curve_every=2,
            ),
        },
    ),
    "Velocity": TaskConfig(
        # The more speed is missing, the larger the swing; a joint that swings the other way brakes.
        gaits={
            "sinusoid": _gait(limited_by="commanded_speed - forward*speed"),
            "steered sinusoid": _gait(steered=True, limited_by="commanded_speed - forward*speed"),
        },
        ppo=_VELOCITY,
        # Without drag it coasts, and small differences of speed decide which way to swing.
        ppo_of={
            "roller_racer": dataclasses.replace(
                _VELOCITY, observation_scale={"speed": 4.0, "sin_heading": 2.0, "commanded_speed": 4.0}
            )
        },
        evaluation=_JUDGED_OFTEN,
    ),
    "Goal": TaskConfig(
        gaits={
            "steered sinusoid": _gait(steered=True, steered_by="atan2(forward*goal_left, forward*goal_ahead)"),
            # To a goal behind it goes backwards, if the mechanism can.
            "steered either way": _gait(steered=True, steered_by="goal_left", limited_by="goal_ahead"),
        },
        ppo=dataclasses.replace(_VARIED, entropy=(0.02, 0.0), levels=3),  # torques below their limits lose time
        evaluation=_JUDGED_OFTEN,
    ),
    # Ostrowski's gaits: what is left to turn, or to go sideways, decides how large they are and which way they work.
    "Turn": TaskConfig(
        gaits={"sinusoid 2:1": _gait(cyclic_ratio=2.0, cyclic_by="atan2(sin_to_turn, cos_to_turn)")},
        ppo=_TURN,
        # With drag nothing coasts back to the start: coming back takes long, and pays late. With a λ of 0.95 one seed
        # of five solved 94 %.
        ppo_of={"snakeboard, drag": dataclasses.replace(_TURN, gamma=0.995, gae_lambda=0.9)},
        evaluation=_JUDGED_OFTEN,
    ),
    "Park": TaskConfig(
        gaits={
            "sinusoid 3:2": _gait(cyclic_ratio=1.5, limited_by="place_left", gain=20.0),
            "steered sinusoid 3:2": _gait(
                cyclic_ratio=1.5, limited_by="place_left", gain=20.0, steered=True, steered_by="sin_to_turn"
            ),
        },
        ppo=dataclasses.replace(_VARIED, timesteps=2_000_000, reward_scale=0.05, start_offset=0.3),
        evaluation=_JUDGED_OFTEN,
    ),
}

# The environments of the main job: the paper's two mechanisms, whose gaits are known.
COMPARED = ("nhenv/SnakeboardForward-v0", "nhenv/RollerRacerForward-v0")


def quick(config: TaskConfig) -> TaskConfig:
    """The same experiment, far too short: it shows that everything runs."""
    return dataclasses.replace(
        config,
        gaits={name: dataclasses.replace(gait, population=16, generations=5) for name, gait in config.gaits.items()},
        ppo=dataclasses.replace(config.ppo, timesteps=50_000, curve_every=2),
        evaluation=dataclasses.replace(config.evaluation, episodes=8),
    )


def within(config: TaskConfig, **env_kwargs: Any) -> TaskConfig:
    """The same experiment in an environment made with these arguments: tuned, trained and judged there."""
    return dataclasses.replace(
        config,
        gaits={name: dataclasses.replace(gait, env_kwargs=env_kwargs) for name, gait in config.gaits.items()},
        ppo=dataclasses.replace(config.ppo, env_kwargs=env_kwargs),
        evaluation=dataclasses.replace(config.evaluation, env_kwargs=env_kwargs),
    )


def check_env_id(env_id: str) -> str:
    """Return `env_id` if there are settings for it; raise ValueError with the nearest known id otherwise."""
    known = [name for name in nhenv.environment_ids() if task_name(name) in CONFIGS]
    if env_id not in known:
        raise ValueError(unknown_name("environment", env_id, known))
    return env_id


def for_env(env_id: str, drag: bool = False, sprint: bool = False) -> TaskConfig:
    """Settings for the task of this environment, with the gaits and the training that fit its mechanism.

    Args:
        env_id: environment.
        drag: whether the mechanism's drag acts where it is tuned, trained and judged.
        sprint: whether to train with what passes the steered gait soonest; ValueError where nobody has looked for it.
    """
    config = CONFIGS[task_name(check_env_id(env_id))]
    mechanism = as_mechanism(gym.spec(env_id).kwargs["mechanism"]).name
    gaits = {name: gait for name, gait in config.gaits.items() if gait.fits(mechanism)}
    where = f"{mechanism}, drag" if drag else mechanism
    if sprint and where not in config.sprint_of:
        raise ValueError(
            f"there are no settings for a sprint on {env_id} with{'' if drag else 'out'} drag, only for Forward of "
            f"{'; '.join(CONFIGS['Forward'].sprint_of)}: leave --sprint out"
        )
    ppo = config.sprint_of[where] if sprint else config.ppo_of.get(where, config.ppo)
    config = dataclasses.replace(config, gaits=gaits, ppo=ppo)
    return within(config, drag=True) if drag else config


def training_seed(run: int) -> int:
    """First of the environment seeds on which run `run` trains."""
    runs = TUNING_SEEDS // SEEDS_PER_RUN
    if not 0 <= run < runs:
        raise ValueError(f"the seed of a run must be from 0 to {runs - 1}, got {run}: larger ones are kept for judging")
    return run * SEEDS_PER_RUN


def task_name(env_id: str) -> str:
    """Name of the task of a registered environment."""
    kwargs: dict[str, Any] = gym.spec(env_id).kwargs
    return tasks.get(kwargs["task"]).name
