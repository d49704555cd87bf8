"""The settings of a run, a tree of frozen dataclasses; the command line is generated from them and their documentation."""

from __future__ import annotations

import dataclasses
import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import inf
from typing import Annotated, Any, Literal

import jax
import tyro

from pcil import modules
from pcil.agents import AGENTS, Agent, DrQV2
from pcil.errors import InputError, brief, check_kinds, check_ranges, json_object
from pcil.files import flat
from pcil.rewards import PCIL, REWARDS, Reward
from pcil.types import Spec

MACHINE_SETTINGS = ("checkpoint_seconds", "keep_replay", "single_environment")
"""Settings that change no result; a run can be resumed with other values."""
REGISTRIES: dict[str, dict[str, Any]] = {"agent": AGENTS, "reward": REWARDS}
EnvKwargs = Annotated[
    dict[str, Any],
    tyro.constructors.PrimitiveConstructorSpec(
        nargs=1,
        metavar="JSON",
        instance_from_str=lambda words: json_object("--env-kwargs", words[0]),
        is_instance=lambda value: isinstance(value, dict),
        str_from_instance=lambda value: [json.dumps(value)],
    ),
]
"""Keyword arguments of an environment; on the command line, one argument in JSON."""


@dataclass(frozen=True)
class Algorithm:
    """Everything that is static in the compiled step, so that runs that differ in seed or length share a compilation."""

    agent: Agent
    reward: Reward
    label: Literal["sampled", "stored"]


@dataclass(frozen=True)
class Run:
    """Every setting of a run. Frames are environment control steps: agent steps times the action repeat."""

    task: Annotated[tyro.conf.Positional[str], tyro.conf.arg(metavar="TASK")]
    """One of the ten tasks (walker_walk), another dm_control suite task, or any Gymnasium id."""
    method: str = "pcil"
    """Name of the method; it chooses the reward and its settings."""
    preset: str = "default"
    """default: what our measurements favour; reward-only: the same without the demonstrations' actions; paper: the paper's
    text; released: what the authors' code does."""
    env_kwargs: EnvKwargs = field(default_factory=dict, hash=False)
    """Keyword arguments of the environment as a JSON object, such as '{"frame_skip": 5}'; they are given to gymnasium.make."""
    seed: int = 1
    """The seed of everything random."""
    frames: int = 500_000
    """Length of the run, in frames. A finished run goes on if it is given more."""
    until: float | None = None
    """End the run early, when the mean return of two evaluations in a row is at least this share of the demonstrations' mean
    return (0.95, for example). By default the run takes all its frames."""
    init: str | None = None
    """The folder of an earlier run or policy of the same sizes, from which the networks of the agent start (a warm start)."""
    demos: str | None = None
    """A shipped task, the folder of a Minari dataset or the id of a local one; by default what ships for the task."""
    num_demos: int | None = None
    """Use only the first N demonstrations; by default all of them."""
    demos_mismatch: Literal["refuse", "scale", "keep"] = "refuse"
    """Demonstrations of an environment with another action box, other arguments or another time step: refuse them, or use them
    with actions scaled from the dataset's box to the environment's, or with the values of the actions kept as recorded."""
    clip_actions: bool = False
    """Clip demonstrated actions that are out of bounds, instead of refusing them."""
    label: Literal["sampled", "stored"] = "sampled"
    """When a step gets its learned reward: every time it is sampled (never stale), or once, when its episode is stored."""
    agent: Agent = field(default_factory=DrQV2)
    """The agent."""
    reward: Reward = field(default_factory=PCIL)
    """The reward."""
    seed_frames: int = 2000
    """Frames before the first update."""
    random_frames: int = 2000
    """Frames of uniformly random actions at the start."""
    cloning_updates: int = 5000
    """Updates of the actor by behavioural cloning alone, before all others, if the agent clones."""
    update_every: int = 2
    """Agent steps per update."""
    replay_steps: int = 500_000
    """Rows of the replay: a row for each agent step, and one more for each episode."""
    evaluate_every: int = 20_000
    """Frames between two evaluations."""
    evaluate_episodes: int = 10
    """Episodes per evaluation."""
    keep_best: bool = False
    """Evaluate and save, of the policy of now and the one saved before, the one that the present reward pays more, in as many
    episodes as an evaluation has, from other starts. The environment's own reward has no part in it, unless the method is given
    that reward."""
    checkpoint_seconds: float = 120.0
    """Minimum time between two checkpoints, in seconds; checkpoints are written between episodes and when the run stops."""
    keep_replay: bool = True
    """Keep the replay in the checkpoint of a finished run, so that the run can go on with a larger `frames`."""
    num_envs: int = 1
    """Number of environments that are stepped side by side during training."""
    single_environment: bool = False
    """Use one environment for training and evaluation, one episode after the other: slower, with the same results."""

    def __post_init__(self) -> None:
        check_kinds(self)
        object.__setattr__(self, "env_kwargs", json_object("env_kwargs", self.env_kwargs))
        if self.label == "sampled" and self.reward.scope == "episode":
            raise InputError(
                f"{type(self.reward).__name__} needs whole episodes in order and can't label sampled steps; use --label stored."
            )
        if self.frames <= self.seed_frames:
            raise InputError(
                f"A run of {self.frames} frames never leaves the {self.seed_frames} frames before the first update; "
                f"give --frames more than {self.seed_frames}."
            )
        if self.reward.batch_size > self.agent.batch_size:
            raise InputError(
                f"The reward's batch of {self.reward.batch_size} agent steps is taken from the agent's batch, which has "
                f"{self.agent.batch_size}; make reward.batch_size at most agent.batch_size."
            )
        if self.single_environment and self.num_envs > 1:
            raise InputError(f"A single environment can't be {self.num_envs} side by side; leave out one of the two settings.")
        check_ranges(
            self,
            update_every=(1, inf),
            num_envs=(1, 1000),
            evaluate_every=(1, inf),
            evaluate_episodes=(1, inf),
            replay_steps=(1, inf),
            frames=(1, inf),
            seed=(0, 2**31 - 1),
            seed_frames=(0, inf),
            random_frames=(0, inf),
            cloning_updates=(0, inf),
            checkpoint_seconds=(0, inf),
        )
        if self.until is not None:
            check_ranges(self, until=(1e-6, inf))

    @property
    def learner(self) -> Algorithm:
        """The settings that are compiled."""
        return Algorithm(self.agent, self.reward, self.label)

    @functools.cached_property
    def own_modules(self) -> tuple[str, ...]:
        """The modules of an agent and a reward that are none of ours, and that of such an agent's actor."""
        kinds = [type(self.agent), type(self.reward)]
        if not modules.is_ours(kinds[0].__module__):
            spec = Spec(obs_dim=2, action_dim=1, action_repeat=1)  # the class of the actor depends on no size
            kinds.append(type(jax.eval_shape(lambda key: self.agent.actor(self.agent.init(spec, key=key)), jax.random.key(0))))
        return tuple(dict.fromkeys(kind.__module__ for kind in kinds if not modules.is_ours(kind.__module__)))

    @property
    def needs_demos(self) -> bool:
        """Whether the run uses demonstrations at all."""
        return self.reward.needs_demos or self.agent.offline

    @property
    def needs_actions(self) -> bool:
        """Whether the run reads the actions of the demonstrations."""
        return self.agent.offline or self.reward.needs_actions

    @property
    def needs_rewards(self) -> bool:
        """Whether the run reads the rewards of the demonstrations: if the agent learns from demonstrated steps and the
        environment's reward has a weight."""
        return self.reward.task_weight != 0 and (self.agent.offline or self.reward.prefill[0] > 0)

    def to_json(self) -> dict[str, Any]:
        """All settings as nested tables; classes have their name in the registry if they are ours, else their path."""
        tree = dataclasses.asdict(self)
        for name in REGISTRIES:
            kind = type(getattr(self, name))
            tree[name] = {"class": registered(name, f"{kind.__module__}:{kind.__qualname__}"), **tree[name]}
        return json.loads(json.dumps(tree))

    @classmethod
    def from_json(cls, settings: dict[str, Any], classes: Mapping[str, type] | None = None) -> Run:
        """The run whose `to_json` gave these settings, in this version or an older one, nested or `pcil.files:flat`.

        A missing setting has the default of its class, so the default of a new setting must be what the code did before it.
        Only agents and rewards of this package are created, and those in `classes`, by path; others raise `InputError`.
        """
        values = renamed(flat(settings))
        parts: dict[str, Any] = {}
        for part, registry in REGISTRIES.items():
            name, known = values.pop(f"{part}.class"), {**registry, **(classes or {})}
            if name not in known:
                raise InputError(
                    f"The {part} {brief(name)} is not part of this package, and code that files name is not run unasked."
                )
            own, first = taken(values, part), {"absorbing": False} if part == "agent" else {}
            for setting in dataclasses.fields(known[name]):
                if setting.default is setting.default_factory is dataclasses.MISSING and setting.name in own:
                    first[setting.name] = own[setting.name]
            parts[part] = changed(known[name](**first), own)
        names = {field.name for field in dataclasses.fields(cls)}
        plain = {name: values.pop(name) for name in list(values) if name in names}
        return changed(cls(**plain, **parts), values)


def taken(settings: dict[str, Any], part: str) -> dict[str, Any]:
    """The settings of a part, which are taken out of flat `settings`."""
    return {name.removeprefix(f"{part}."): settings.pop(name) for name in list(settings) if name.startswith(f"{part}.")}


RENAMED = {"agent.standardise": "agent.normalize_observations"}
"""Names of settings in older versions, and their names today."""


def renamed(settings: dict[str, Any]) -> dict[str, Any]:
    """Flat settings with the names that settings and classes have today."""
    values = {}
    for name, value in settings.items():
        part, _, rest = name.partition(".")
        values[RENAMED.get(name, name)] = registered(part, value) if rest == "class" and part in REGISTRIES else value
    return values


def registered(part: str, path: str) -> str:
    """The name in the registry for the path of one of our classes, in this version or an older one; other names are
    returned unchanged."""
    own = {kind.__qualname__: name for name, kind in REGISTRIES[part].items()}
    module, _, name = path.partition(":")
    return own.get(name, path) if module.startswith("pcil.") else path


def part_of_run(part: str, spec: str) -> Any:
    """The class with a name in the registry, or the class `my.module:MyClass`, whose module is imported."""
    if spec in REGISTRIES[part]:
        return REGISTRIES[part][spec]
    base = {"agent": Agent, "reward": Reward}[part]
    return modules.load(f"--{part}", spec, base, f"one of {', '.join(REGISTRIES[part])}, or my.module:My{base.__name__}")


def run_of_file(source: str, settings: dict[str, Any], trust: Sequence[str]) -> Run:
    """The run of the settings in the file `source`. An agent or a reward that is none of ours is imported where `trust` has its
    module; `InputError` where it does not."""
    values, classes = renamed(flat(settings)), {}
    for part in REGISTRIES:
        if named := modules.of_class(name := values[f"{part}.class"], REGISTRIES[part]):
            modules.admit(source, named, trust)
            classes[name] = part_of_run(part, name)
    return Run.from_json(values, classes)


def changed(settings: Any, changes: dict[str, Any]) -> Any:
    """Settings with some fields changed; a dotted name such as "agent.noise.steps" is a field of nested settings.

    Raises `InputError`, which lists the fields, for a name that is not a field.
    """
    names = [field.name for field in dataclasses.fields(settings)]
    own: dict[str, Any] = {}
    nested: dict[str, dict[str, Any]] = {}
    for name, value in changes.items():
        first, _, rest = name.partition(".")
        if first not in names or (rest and not dataclasses.is_dataclass(getattr(settings, first))):
            raise InputError(f"{type(settings).__name__} has no setting {name!r}; it has {', '.join(names)}.")
        if rest:
            nested.setdefault(first, {})[rest] = value
        else:
            own[name] = value
    own |= {name: changed(own.get(name, getattr(settings, name)), inner) for name, inner in nested.items()}
    return dataclasses.replace(settings, **own)


def differences(old: dict[str, Any], new: dict[str, Any], prefix: str = "") -> list[str]:
    """The differences between the settings of two runs, such as "agent.gamma was 0.99, now 0.9", without machine settings."""
    found = []
    for name in dict.fromkeys([*old, *new]):
        before, after = old.get(name), new.get(name)
        if isinstance(before, dict) and isinstance(after, dict):
            found += differences(before, after, f"{prefix}{name}.")
        elif before != after and name not in MACHINE_SETTINGS:
            found.append(f"{prefix}{name} was {before}, now {after}")
    return found
