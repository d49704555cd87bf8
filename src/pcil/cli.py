"""The command line. Every command imports what it needs when it runs, so that `pcil --help` answers at once."""

import contextlib
import importlib
import io
import json
import os
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from pcil import arguments, errors
from pcil.errors import InputError, shown

if TYPE_CHECKING:
    from pcil.config import Run


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; 0 on success, 2 on bad input, 1 where a run failed, 130 and 143 where Ctrl-C and SIGTERM stopped it."""
    # XLA has threads of its own; those of NumPy's BLAS only wait for each other on the small matrices of this package.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # of a terminal that can't show every letter
    words = list(sys.argv[1:] if arguments is None else arguments)
    try:
        code = _command(words)
        sys.stdout.flush()
        return code
    except KeyboardInterrupt:
        again = "; the same command goes on from the last checkpoint" if words[0] in ("train", "sweep") else ""
        print(f"pcil: stopped{again}.", file=sys.stderr)
        return 130
    except BrokenPipeError:
        with open(os.devnull, "w") as nowhere:
            os.dup2(nowhere.fileno(), sys.stdout.fileno())  # or Python would complain of the rest at its end
        return 141
    except Exception as error:
        if not (said := errors.said(error)):
            raise
        print(f"pcil: {said[0]}.", file=sys.stderr)
        return said[1]


def _command(words: list[str]) -> int:
    if not words or words[0] in ("-h", "--help"):
        print(_overview())
        return 0
    if words[0] == "--version":
        print(f"pcil {importlib.import_module('pcil').__version__}")
        return 0
    if words[0] not in COMMANDS:
        raise InputError(f"There is no command {words[0]!r}; the commands are {', '.join(COMMANDS)}.")
    return COMMANDS[words[0]](words[1:])


def _overview() -> str:
    lines = ["usage: pcil COMMAND ...", "", "Policies from demonstrations.", "", "commands:"]
    lines += [f"  {name:<10}{(command.__doc__ or '').splitlines()[0]}" for name, command in COMMANDS.items()]
    return "\n".join([*lines, "", "pcil COMMAND --help tells more; pcil --version prints the version."])


def _train(words: list[str]) -> int:
    """Train a policy, or resume where a run stopped."""
    return arguments.train(words, _run)


def _run(run: "Run", out: Path) -> int:
    """Execute with a progress bar; end with a plain statement of how close to the expert it came, and the curve."""
    from pcil import envs, loop, progress, runs

    demos = runs.demonstrations(run)
    expert = demos.return_mean if demos else _shipped_return(envs.task_name(run.task))
    with progress.Bar(progress.Screen(), expert) as bar:
        try:
            result = runs.execute(run, out, bar)
        except loop.Stopped:
            bar.say(f"Stopped; the run in {out} is saved, and the same command goes on from here.")
            return 128 + int(bar.signal or 0)
        if not bar.evaluations:
            bar.say(f"The run in {out} is done.")
        share = f", {progress.compared(result.final_return, expert)}" if expert is not None else ""
        bar.say(f"Final return {result.final_return:.1f}{share} (mean of {run.evaluate_episodes} episodes).")
        bar.say(f"Policy: {result.folder / 'policy'}")
        _draw_curve(result.folder, expert, bar)
    return 0


def _draw_curve(out: Path, expert: float | None, bar: Any) -> None:
    from pcil import files

    try:
        from pcil.report import figures
    except ImportError:
        bar.say("No learning curve is drawn without matplotlib; pip install '.[report]' in a clone brings it.")
    else:
        with files.room_for(f"Drawing {out / 'curve.png'}"):
            bar.say(f"Learning curve: {figures.run_curve(out, expert)}")


def _shipped_return(task: str) -> float | None:
    from pcil.demos import shipped

    return {row["task"]: row["return_mean"] for row in shipped()}.get(task)


def _evaluate(words: list[str]) -> int:
    """Roll out the policy of a run, without exploration."""
    import tyro

    from pcil.config import EnvKwargs
    from pcil.modules import Trust

    def evaluate(
        folder: Path,
        /,
        episodes: int = 10,
        seed: int = 0,
        env_kwargs: EnvKwargs | None = None,
        single_environment: bool = False,
        trust: Trust = (),
        json_output: Annotated[bool, tyro.conf.arg(name="json")] = False,
    ) -> int:
        """Roll out the policy of a run, without exploration.

        Args:
            folder: A run's folder, or one that holds policy.json and policy.safetensors.
            episodes: How many.
            seed: The episodes' starts follow from it.
            env_kwargs: Keyword arguments of the environment, as a JSON object; by default those it was trained with.
            single_environment: Play one episode after the other in one environment: slower, with the same results.
            trust: Modules that the policy's files may name, whose code is then run, such as my.module.
            json_output: Print one JSON object and nothing else.
        """
        from pcil.evaluate import environments_for, playable
        from pcil.evaluate import evaluate as roll_out

        arguments.within(1, 100_000, episodes=episodes)
        arguments.within(0, 2**31 - 1, seed=seed)
        policy, env_kwargs = playable(folder, env_kwargs, trust)
        copies = environments_for(policy.task, episodes, env_kwargs, single=single_environment)
        with contextlib.redirect_stdout(sys.stderr), copies as made:  # an environment may print
            policy.check_fits(made[0])
            result = roll_out(policy, made, seed=seed, episodes=episodes)
        row = {"task": policy.task, "episodes": episodes, "seed": seed, "return_mean": result.mean}
        row |= {"return_std": float(result.returns.std()), "returns": result.returns.tolist()}
        if json_output:
            print(json.dumps(row))
        else:
            print(f"{shown(policy.task)}: return {result.mean:.1f} +- {row['return_std']:.1f} over {episodes} episodes")
            print("  " + "  ".join(f"{value:.1f}" for value in result.returns))
        return 0

    return arguments.call("evaluate", evaluate, words)


def _demos(words: list[str]) -> int:
    """List the demonstrations that ship."""
    import tyro

    def demos(json_output: Annotated[bool, tyro.conf.arg(name="json")] = False) -> int:
        """List the demonstrations that ship.

        Args:
            json_output: Print one JSON list and nothing else.
        """
        from pcil.demos import shipped, table

        rows = shipped()
        print(json.dumps(rows) if json_output else "\n".join(table(rows)))
        return 0

    return arguments.call("demos", demos, words)


def _record(words: list[str]) -> int:
    """Record demonstrations from a trained policy."""
    from pcil.config import EnvKwargs
    from pcil.modules import Trust

    def record(
        folder: Path,
        /,
        out: Path,
        episodes: int = 10,
        seed: int = 0,
        minimum_return: float | None = None,
        env_kwargs: EnvKwargs | None = None,
        trust: Trust = (),
    ) -> int:
        """Record demonstrations from a trained policy, as a Minari dataset.

        Args:
            folder: A run's folder, or one that holds policy.json and policy.safetensors.
            out: The dataset's folder; it must not exist.
            episodes: How many.
            seed: The episodes' starts follow from it.
            minimum_return: Keep only episodes of at least this return.
            env_kwargs: Keyword arguments of the environment, as a JSON object; by default those it was trained with.
            trust: Modules that the policy's files may name, whose code is then run, such as my.module.
        """
        from pcil import demos, envs, evaluate, runs

        arguments.within(1, 100_000, episodes=episodes)
        arguments.within(0, 2**31 - 1, seed=seed)
        demos.free_folder(out)
        policy, played = evaluate.playable(folder, env_kwargs, trust)
        least = "" if minimum_return is None else f" --minimum-return {minimum_return:g}"
        least += "" if env_kwargs is None else f" --env-kwargs '{json.dumps(env_kwargs)}'"
        least += f" --trust {' '.join(trust)}" if trust else ""
        info = runs.provenance(folder, policy, f"pcil record {folder} --episodes {episodes} --seed {seed}{least} --out {out}")
        asked: Any = {"task": policy.task, "seed": seed, "minimum_return": minimum_return, "info": info}
        with envs.opened(policy.task, env_kwargs=played) as env:
            policy.check_fits(env)
            recorded = demos.record(policy, env, episodes, **asked)
        path = recorded.save(out)
        returns = f"{recorded.return_mean:.1f} +- {recorded.return_std:.1f}"
        print(f"{episodes} episodes of {shown(policy.task)}, return {returns}: {shown(str(path))}")
        return 0

    return arguments.call("record", record, words)


def _theory(words: list[str]) -> int:
    """Check the paper's Theorem 1 numerically, and draw it."""
    import tyro

    def check(out: Path | None = None, seed: int = 0, json_output: Annotated[bool, tyro.conf.arg(name="json")] = False) -> int:
        """Check the paper's Theorem 1 numerically, and draw it.

        Args:
            out: Folder of theory.png and theory.pdf; by default the current one, or no figure with --json.
            seed: The random pairs follow from it.
            json_output: Print one JSON object and nothing else.
        """
        from pcil import theory

        arguments.within(0, 2**31 - 1, seed=seed)
        pairs = [theory.random_pairs(atoms, seed=seed) for atoms in theory.ATOMS]
        figures = theory.measure(pairs)
        drawn = ""
        if out is not None or not json_output:
            try:
                from pcil.report.theory import draw
            except ImportError:
                drawn = "No figure is drawn without matplotlib; pip install '.[report]' in a clone brings it."
            else:
                drawn = shown(f"Figure: {draw(pairs, out or Path())}")
        print(json.dumps(figures) if json_output else f"{theory.table(figures)}\n\n{drawn}")
        if json_output and drawn:
            print(drawn, file=sys.stderr)
        return 0

    return arguments.call("theory", check, words)


def _report(words: list[str]) -> int:
    """Draw figures, tables and a page from runs."""
    from pcil.reporting import report

    return arguments.call("report", report, words)


def _sweep(words: list[str]) -> int:
    """Train many runs, side by side."""
    from pcil import sweeping

    return sweeping.command(words)


def _bench(words: list[str]) -> int:
    """Measure the speed of each part, and its ratio to the floor."""
    import tyro

    def bench(
        task: str = "walker_walk",
        preset: str = "default",
        seconds: float = 20.0,
        json_output: Annotated[bool, tyro.conf.arg(name="json")] = False,
    ) -> int:
        """Measure the speed of each part, and its ratio to the floor, on one thread.

        Args:
            task: The environment, and the sizes of its networks.
            preset: Settings of PCIL whose update is measured.
            seconds: About how long to measure.
            json_output: Print one JSON object and nothing else.
        """
        from pcil import bench

        if not 0 < seconds < 86_400:
            raise InputError(f"--seconds is {seconds}; it must be above 0 and below a day.")
        figures = bench.measure(task, preset, seconds)
        print(json.dumps(figures) if json_output else bench.table(figures))
        return 0

    return arguments.call("bench", bench, words)


def _doctor(words: list[str]) -> int:
    """Say what is installed, what is wrong, and what to do."""

    def doctor() -> int:
        """Say what is installed, what is wrong, and what to do; exit code 1 where training can't work."""
        from pcil import doctor

        return doctor.report()

    return arguments.call("doctor", doctor, words)


COMMANDS: dict[str, Callable[[list[str]], int]] = {
    "train": _train,
    "evaluate": _evaluate,
    "demos": _demos,
    "record": _record,
    "theory": _theory,
    "report": _report,
    "sweep": _sweep,
    "bench": _bench,
    "doctor": _doctor,
}
