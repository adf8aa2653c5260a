"""Write trained policies as plain data, each with a card that says how it came about and what it does.

python -m training.export runs/compare --out training/shipped
python -m training.export runs/compare/SnakeboardForward-v0/ppo-seed0-0123456789ab.zip

Of a folder of `training.compare`, the median seed of each environment is written: neither the best nor
the worst.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import tyro
from rich.console import Console
from stable_baselines3.common.torch_layers import FlattenExtractor
from torch import nn

from training import policies
from training.config import EVALUATION_SEEDS, check_env_id, for_env
from training.evaluate import evaluate, load_policy
from training.levels import LevelPolicy
from training.metrics import METRICS, headline, metric_of, metrics_of
from training.report import cell, markdown_table
from training.rollout import PolicyController, make_envs
from training.scaling import Scaled
from training.statistics import median_run, summary
from training.store import read_json, settings, versions, write_bytes, write_json
from training.train import MODULES

__all__ = ["actor", "card_text", "chosen", "export"]


def actor(controller: PolicyController) -> tuple[dict[str, Any], policies.Layers]:
    """Network behind the deterministic action, as a card tells of it, and its layers.

    Raises:
        ValueError: it is something else than linear layers with one of the activations between them.
    """
    policy = controller.model.policy
    net, head = policy.mlp_extractor.policy_net, policy.action_net
    inner, between = [*net.children()][::2], [*net.children()][1::2]
    linear = [layer for layer in (*inner, head) if isinstance(layer, nn.Linear)]
    extractor = policy.features_extractor
    plain = type(extractor) in (FlattenExtractor, Scaled) and not policy.squash_output
    plain &= len(linear) == len(inner) + 1 == len(between) + 1
    # A module's text tells its slope, too.
    fitting = [name for name, module in MODULES.items() if all(repr(one) == repr(module()) for one in between)]
    if not (plain and fitting):
        raise ValueError(
            f"only networks of linear layers with one of {list(MODULES)} between them can be exported, got "
            f"{extractor}, {net}, {head}, squash_output={policy.squash_output}"
        )
    layers = [(layer.weight.detach().numpy(), layer.bias.detach().numpy()) for layer in linear]
    if isinstance(extractor, Scaled):  # whose factors are as good in the first layer
        (weight, bias), *others = layers
        layers = [(weight * extractor.factors.numpy()[: weight.shape[1]], bias), *others]
    network = {"activation": fitting[0], "layers": [linear[0].in_features, *(layer.out_features for layer in linear)]}
    return network | ({"levels": policy.levels} if isinstance(policy, LevelPolicy) else {}), layers


def export(path: Path, out: Path, *, name: str | None = None, episodes: int = 100, why: str = "") -> Path:
    """Write a policy as NAME.safetensors, NAME.json and NAME.md, judge what was written, and return the first path.

    Args:
        path: zip file of `training.train` or `training.compare`, with its history beside it. It is unpickled.
        out: folder.
        name: name of the files; None for the environment's, and its arguments.
        episodes: episodes behind the figures on the card.
        why: why this policy and no other.
    """
    beside = path.with_suffix(".json")
    if path.suffix != ".zip" or not path.is_file() or not beside.is_file():
        raise ValueError(f"a policy to export is a .zip file of training.train, its .json file beside it, got {path}")
    history = read_json(beside)
    learned, result = history["settings"], history["result"]
    env_id, env_kwargs = check_env_id(learned["env_id"]), learned["ppo"]["env_kwargs"]
    now = json.loads(json.dumps(settings(env_id, "")))
    for part in ("mechanism", "task", "max_episode_steps"):
        if learned[part] != now[part]:
            raise ValueError(f"{path} learned with another {part} of {env_id} than there is now: train it again")
    controller = load_policy(path)
    assert isinstance(controller, PolicyController)
    network, layers = actor(controller)
    envs, content = make_envs(env_id, 1, **env_kwargs), policies.pack(layers)
    card: dict[str, Any] = {
        "format": policies.FORMAT,
        "env_id": env_id,
        "env_kwargs": env_kwargs,
        "observation": list(envs.observation_labels),
        "action": list(envs.mechanism.controls),
        "network": network,
        "sha256": hashlib.sha256(content).hexdigest(),
        "chosen": why,
        "training": {
            "command": command(learned),
            "run": path.stem,
            "seed": learned["seed"],
            "settings": learned["ppo"],
            **{key: result[key] for key in ("steps", "cpu_s", "wall_s", "versions")},
        },
    }
    config = dataclasses.replace(for_env(env_id).evaluation, env_kwargs=env_kwargs, episodes=episodes)
    written = policies.read(card, content)
    _, numbers = evaluate(written, env_id, config)
    _, fine = evaluate(written, env_id, config, substeps=config.fine_substeps * envs.substeps)
    first = headline(envs.task)
    card["evaluation"] = {
        "episodes": episodes,
        "first_seed": EVALUATION_SEEDS,
        "metrics": {m.name: summary(numbers[m.name], m.statistic) for m in metrics_of(envs.task)},
        "finely_integrated": {first.name: summary(fine[first.name], first.statistic)},
        "versions": versions(),
    }
    if name is None:
        made_with = "".join(f"-{key}" if value is True else f"-{key}-{value}" for key, value in env_kwargs.items())
        name = env_id.rpartition("/")[2] + made_with
    target = out / f"{name}{policies.SUFFIX}"
    write_json(target.with_suffix(".json"), card)
    write_bytes(target.with_suffix(".md"), card_text(card, name).encode())
    write_bytes(target, content)
    return target


def command(learned: Mapping[str, Any]) -> str:
    """Command that trains a policy, given the settings that its history has."""
    env_id, ppo = learned["env_id"], learned["ppo"]
    drag = bool(ppo["env_kwargs"].get("drag"))
    options = f"{' --drag' if drag else ''}{' --sprint' if _sprinted(env_id, drag, ppo) else ''}"
    return (
        f"python -m training.train --env-id {env_id} --seed {learned['seed']} --timesteps {ppo['timesteps']}{options}"
    )


def _sprinted(env_id: str, drag: bool, ppo: Mapping[str, Any]) -> bool:
    """Whether these settings, as they are read back, are those of a sprint, however long."""
    try:
        sprint = dataclasses.replace(for_env(env_id, drag, sprint=True).ppo, timesteps=ppo["timesteps"])
    except ValueError:  # there is none
        return False
    return bool(json.loads(json.dumps(dataclasses.asdict(sprint))) == ppo)


def chosen(folder: Path) -> Iterator[tuple[Path, str]]:
    """Zip file of the median seed of each environment of a comparison, and why it was chosen."""
    results = folder / "results.json"
    if not results.is_file():
        raise ValueError(f"there is no {results}: give a folder of a finished training.compare, or a .zip file")
    for one in read_json(results)["environments"].values():
        metric, runs = metric_of(one["headline"]), one["ppo"]
        middle = runs[median_run([run[metric.name]["estimate"] for run in runs], metric.better)]
        why = f"the median of {len(runs)} seeds by {metric.heading}"
        yield (folder / middle["file"]).with_suffix(".zip"), why


def card_text(card: Mapping[str, Any], name: str) -> str:
    """The card as a Markdown document."""
    training, judged = card["training"], card["evaluation"]
    made_with = ", ".join(f"{key}={value!r}" for key, value in card["env_kwargs"].items())
    measured = {metric: judged["metrics"][metric.name] for metric in METRICS if metric.name in judged["metrics"]}
    figures = [(metric.heading, metric.statistic, cell(one, metric)) for metric, one in measured.items()]
    (first, fine), *_ = ((metric_of(name), one) for name, one in judged["finely_integrated"].items())
    figures.append((f"{first.heading}, at a tenth of the step", first.statistic, cell(fine, first)))
    libraries = ", ".join(f"{library} {version}" for library, version in training["versions"].items())
    set_to = [(key, json.dumps(value)) for key, value in training["settings"].items()]
    levels = card["network"].get("levels")
    chosen_from = f", each one of {levels} values" if levels else ""
    lines = [
        f"# {name}",
        "",
        f"A policy for `{card['env_id']}`"
        + (f" with `{made_with}`" if made_with else "")
        + f": a {card['network']['activation'].replace('_', ' ')} network of sizes "
        f"{card['network']['layers']}, from {', '.join(card['observation'])} to {', '.join(card['action'])} over their "
        f"limits{chosen_from}. It learned in simulation alone; of a machine it knows nothing.",
        "",
        "```python",
        "from training.policies import load",
        "",
        f'policy = load("{name}{policies.SUFFIX}")',
        "action = policy(observation)",
        "```",
        "",
        f"## What it does: {judged['episodes']} episodes that it did not learn from",
        "",
        markdown_table(("", "statistic", "value [95 % interval]"), figures),
        "",
        "## How it came about",
        "",
        f"`{training['command']}`, with the settings below, {training['steps']:,} steps, {training['cpu_s']:.0f} s of "
        f"CPU time; {libraries}." + (f" It is {card['chosen']}." if card["chosen"] else ""),
        "",
        markdown_table(("setting", "value"), set_to),
        "",
    ]
    return "\n".join(lines)


@dataclass(frozen=True)
class Export:
    """Write trained policies as plain data.

    The zip files are unpickled, which can run any code: only load files that you trust.

    Attributes:
        source: zip file of a policy, or folder of a comparison, of which the median seeds are written.
        out: folder of what is written.
        name: name of the files; None for one made of the environment's. For one policy only.
        episodes: episodes behind the figures on the card.
    """

    source: tyro.conf.Positional[Path]
    out: Path = Path("runs/policies")
    name: str | None = None
    episodes: int = 100


def main(options: Export) -> None:
    """Write what was asked for."""
    one = options.source.suffix == ".zip"
    sources = [(options.source, "")] if one else list(chosen(options.source))
    if options.name is not None and len(sources) > 1:
        raise ValueError(f"one name for {len(sources)} policies: leave out --name, or give one .zip file")
    for path, why in sources:
        target = export(path, options.out, name=options.name, episodes=options.episodes, why=why)
        Console().print(f"{target}, {target.stat().st_size:,} bytes, and its card", soft_wrap=True)


if __name__ == "__main__":
    main(tyro.cli(Export, prog="python -m training.export"))
