"""Laws in closed form that beat every sinusoid, by the mechanism that each is made for.

law           what they have in common
snakeboard    a rotor that always pushes, with steering that swings, charges first, or follows a chirp
roller_racer  a relay
"""

from mechanics.expressions import unknown_name
from nhenv.env import LocomotionEnv
from nhenv.vector_env import LocomotionVectorEnv
from training.config import LawConfig
from training.family import Family
from training.laws import roller_racer, snakeboard
from training.laws.law import Law

__all__ = ["LAWS", "Law", "law_family"]

# mechanism -> name of the law -> law
LAWS: dict[str, dict[str, type[Law]]] = {
    "snakeboard": {
        "bang-bang": snakeboard.BangBang,
        "charge, then go": snakeboard.ChargeThenGo,
        "chirped steering": snakeboard.ChirpedSteering,
    },
    "roller_racer": {"relay": roller_racer.Relay},
}


def law_family(env: LocomotionEnv | LocomotionVectorEnv, config: LawConfig, duration: float) -> Family:
    """The law of this name, for an environment of its mechanism; what drifts has done so after `duration` seconds."""
    laws = LAWS.get(env.mechanism.name, {})
    if config.law not in laws:
        raise ValueError(unknown_name(f"law of {env.mechanism.name}", config.law, laws))
    law = laws[config.law]
    return Family(law.RANGES, lambda vector: law(env, duration, vector))
