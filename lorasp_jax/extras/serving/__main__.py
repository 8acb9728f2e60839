"""Serve a policy: `python -m lorasp_jax.extras.serving runs/NAME`."""

import argparse
import asyncio
import contextlib
import functools
import logging
import os
import secrets
import signal
import socket
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from lorasp_jax.base.arguments import NAME, indices, named, pair, positive
from lorasp_jax.base.errors import run_command
from lorasp_jax.extras.serving import manager

GRACE = 5.0
"""Time that the policy has for its last answer [s]; a container is killed 10 s after SIGTERM."""
_SIGNALS = (signal.SIGINT, signal.SIGTERM)
UNSAID = ("openpi_config", "size", "chunk", "relative", "prompt_state", "joints", "action_length")
"""Options that say what the files of a published checkpoint do not; see `checkpoint.Unsaid`."""
CHECKPOINT_OPTIONS = ("statistics", "dataset", "dtype", "camera", "adapter", *UNSAID)
"""Options for published checkpoints."""


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.serving") -> int:
    """Serve until SIGINT or SIGTERM; return the exit code, one of `lorasp_jax.base.errors`.

    Exit with 1 if the policy hangs then.
    """
    options = parser(program).parse_args(arguments)
    return run_command(lambda: _serve(options, Console()))


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Serve a policy over websockets, in openpi's protocol or vla-eval's.",
        epilog="Pages on the same port: / for people, /healthz, /status and /metrics. See "
        "docs/serving.md.",
    )
    add = parser.add_argument
    add(
        "policy",
        nargs="+",
        type=named,
        metavar="[NAME=]POLICY",
        help="folder of a finished run or an exported policy, or a published checkpoint (folder, "
        "hf://owner/name or gs://bucket/folder). Several runs: requests choose by NAME, the first "
        "is the default",
    )
    add("--host", default="127.0.0.1", help="address to listen on; others than the default need a "
        "token (default: %(default)s)")  # fmt: skip
    add("--port", type=int, default=8000, help="default: %(default)s")
    add("--token-file", type=Path, metavar="FILE", help="file with the token of the clients; "
        "written with a fresh one if there is none, and made readable only by you")  # fmt: skip
    add("--max-clients", type=positive, help="maximum number of connections (default: 64)")
    add("--prompt", default="", help="instruction of requests that have none")
    add("--max-batch", type=int, help="largest batch (default: 8)")
    add("--denoise-steps", type=positive, metavar="N", help="flow steps (default: as in a run's "
        "evaluation; 10 for a checkpoint)")  # fmt: skip
    add("--seed", type=int, help="seed of the flow's noise, which repeats what a server answered "
        "(default: a fresh one, which is printed)")  # fmt: skip
    add(
        "--execution",
        default="naive",
        choices=("naive", "trained", "guided"),
        help="whether chunks can continue the previous one, as learned in training or by guidance "
        "(default: %(default)s); see docs/latency.md",
    )
    add("--adapters-on-device", type=positive, metavar="K", help="keep the weights of "
        "K adapters on the device and the others in host memory, on one base (default: with "
        "several adapters, all on the device)")  # fmt: skip
    add("--route", choices=("name", "exact", "nearest"), default="name", help="which adapter "
        "answers requests that name none: the first, the one trained with the instruction, or with "
        "the nearest one; both refuse what is not clear (default: %(default)s)")  # fmt: skip
    add("--any-base", action="store_true", help="accept adapters of another base than they record")
    add("--guidance", type=float, help="limit of the guidance (default: 10)")
    add("--vla-eval", type=positive, metavar="N", help="answer vla-eval's protocol, executing N "
        "actions of each chunk; it knows no token, so only on 127.0.0.1")  # fmt: skip
    add("--base", default="", help="the run's base, if it has moved")
    add("--tokenizer", default="", help="the policy's tokenizer; runs record theirs")
    _add_checkpoint_options(parser.add_argument_group("published checkpoints"))
    return parser


def _add_checkpoint_options(group: Any) -> None:
    checkpoint = group.add_argument
    checkpoint("--statistics", default="", help="normalization, if not in the checkpoint")
    checkpoint("--dataset", default="", help="which dataset's statistics, if there are several; "
        "or, of a run, for which of its datasets, if they differ")  # fmt: skip
    checkpoint("--openpi-config", help="openpi's training config, such as pi05_libero, "
        "which says all that follows (default: that which the folder is named after)")  # fmt: skip
    checkpoint("--size", help="size of the model: base or base_pi05")
    checkpoint("--chunk", type=positive, help="actions per chunk")
    checkpoint("--relative", type=indices, metavar="NUMBERS", help="actions that are relative to "
        "the state: none, or their numbers, such as 0-5,7-12")  # fmt: skip
    checkpoint("--prompt-state", choices=("yes", "no"), help="whether prompts contain the state")
    checkpoint("--joints", type=positive, help="number of joints; states have one number more")
    checkpoint("--action-length", type=positive, help="numbers in an action, if not as in a state")
    checkpoint("--dtype", default="", choices=("", "float32", "bfloat16"), help="of the weights")
    pairs: Any = {"action": "append", "type": pair, "default": [], "metavar": "NAME=VALUE"}
    checkpoint("--camera", **pairs, help="the backbone's camera = the robot's camera, repeatedly")
    checkpoint("--adapter", **pairs, help="name = adapter folder, repeatedly; see docs/serving.md")


def _serve(options: argparse.Namespace, console: Console) -> None:
    from lorasp_jax.extras.serving import server

    logging.basicConfig(format="%(asctime)s %(message)s")
    logging.getLogger("lorasp_jax.extras.serving").setLevel(logging.INFO)
    if options.vla_eval:
        from lorasp_jax.extras.serving import vla_eval  # before what takes long

        _refuse(options, ("token_file", "max_clients"), "has no effect with --vla-eval")
    token = _read_token(options.token_file, console)
    with server.bind(options.host, options.port, token=token) as port:  # before what takes long
        policy: Any = _load(options, console)
        if options.vla_eval:
            policy_server: Any = vla_eval.VlaEvalServer(policy, options.vla_eval)
        else:
            limit = {"max_clients": options.max_clients} if options.max_clients else {}
            more = {**limit, "about": _about(options)}
            policy_server = server.PolicyServer(policy, token=token, **more)
        answers = asyncio.run(_run(policy_server, port, console))
    if not answers:
        from lorasp_jax.training.distributed import processes

        _say(console, f"the policy has not answered within {GRACE:g} s, or loads: ended without it")
        processes.exit_all(1)  # a thread that hangs cannot be stopped


def _about(options: argparse.Namespace) -> dict[str, str]:
    """Return where the policies are from, for the server's page."""
    about = {"from": ", ".join(path for _, path in options.policy), "base": options.base}
    return {name: text for name, text in about.items() if text}


async def _run(policy_server: Any, port: socket.socket, console: Console) -> bool:
    """Serve until SIGINT or SIGTERM; return whether the policy then still answered.

    A service manager is told when clients can connect, and that the policy answers. A second
    signal ends the process by the system, whatever hangs.
    """
    stop, loop = asyncio.Event(), asyncio.get_running_loop()
    for number in _SIGNALS:
        loop.add_signal_handler(number, stop.set)
    host, number = port.getsockname()[:2]  # now, as a server may open the port itself
    host = f"[{host}]" if ":" in host else host
    async with policy_server.listen(port):
        _say(console, f"listening on ws://{host}:{number}")
        manager.notify("READY=1")
        watch = asyncio.create_task(manager.watch(policy_server.problem))
        await stop.wait()
        watch.cancel()
        manager.notify("STOPPING=1")
        for number in _SIGNALS:
            loop.remove_signal_handler(number)
            signal.signal(number, signal.SIG_DFL)
        _say(console, "closing connections")
        return await asyncio.to_thread(policy_server.close, GRACE)


def _load(options: argparse.Namespace, console: Console) -> Any:
    """Load and compile the policies, saying what takes long."""
    from lorasp_jax.base import compilation_cache as cache
    from lorasp_jax.extras.serving.exported import is_bundle, is_exported
    from lorasp_jax.extras.serving.served import ServedPolicies

    named, start = dict(options.policy), time.monotonic()
    names = [name for name, _ in (*options.policy, *options.adapter)]
    if len({*names}) < len(names):
        raise ValueError("the policies must have different names: pass NAME=POLICY")
    if unfit := [name for name in names if not NAME.fullmatch(name)]:
        raise ValueError(f"names must match {NAME.pattern}, got {unfit[0]!r}: pass NAME=POLICY")
    cache.enable()
    seed = secrets.randbelow(2**31) if options.seed is None else options.seed
    _say(console, f"loading {', '.join(named.values())} with --seed {seed}")
    exported = all(is_exported(path) or is_bundle(path) for path in named.values())
    policies, load = (_exported if exported else _compiled)(options, named)
    settings = {"prompt": options.prompt, "execution": options.execution, "route": options.route}
    policy = ServedPolicies(policies, seed=seed, load=load, **settings)
    policy.warm_up(functools.partial(_say, console))
    _say(console, f"ready after {time.monotonic() - start:.0f} s")
    return policy


def _exported(options: argparse.Namespace, named: dict[str, str]) -> tuple[dict[str, Any], None]:
    """Load exported policies."""
    from lorasp_jax.extras.serving.exported import is_bundle, load, load_bundle

    settings = ("denoise_steps", "max_batch", "guidance", "base", "tokenizer", "adapters_on_device")
    _refuse(options, (*settings, *CHECKPOINT_OPTIONS), "has no effect on exported policies")
    if options.execution == "guided":
        raise ValueError("exported policies cannot be guided: use --execution naive or trained")
    if options.route == "nearest":
        raise ValueError("exported policies understand only their instructions: use --route exact")
    if any(map(is_bundle, named.values())):
        if len(named) > 1:
            raise ValueError("a folder of several exported policies is served alone")
        return load_bundle(*named.values()), None
    return {name: load(folder) for name, folder in named.items()}, None


def _compiled(
    options: argparse.Namespace, named: dict[str, str]
) -> tuple[dict[str, Any], Callable[[str], Any] | None]:
    """Load runs or a checkpoint; return the policies, and what loads further ones, if anything."""
    from lorasp_jax.extras.serving.adapters import OnDevice
    from lorasp_jax.extras.serving.policies import CompiledPolicy, batch_sizes
    from lorasp_jax.training.export import is_run

    if options.max_batch is not None:
        batch_sizes(options.max_batch)  # an invalid one is refused before what takes long
    given = {"num_steps": options.denoise_steps, "max_batch": options.max_batch}
    settings = {name: value for name, value in given.items() if value is not None}
    if options.execution == "guided":
        settings["guidance"] = 10.0 if options.guidance is None else options.guidance
    several = len(named) > 1 or bool(options.adapter)
    share = several or options.adapters_on_device is not None
    if options.route == "nearest" and not share:
        raise ValueError("--route nearest is for several adapters")
    place = OnDevice(options.adapters_on_device)
    compiled = functools.partial(CompiledPolicy, **settings, place=place)
    if all(map(is_run, named.values())):
        others = [name for name in CHECKPOINT_OPTIONS if name != "dataset"]
        _refuse(options, others, "is for published checkpoints: runs record theirs")
        return _runs(options, named, compiled, share)
    if len(named) > 1:
        raise ValueError("several policies must all be finished runs, or all be exported")
    _refuse(options, ("base",), "is for runs")
    return _checkpoint(options, next(iter(named.values())), compiled, share)


def _runs(
    options: argparse.Namespace,
    named: dict[str, str],
    compiled: Callable[[Any], Any],
    share: bool,
) -> tuple[dict[str, Any], Callable[[str], Any] | None]:
    """Load runs, those of one base with only one copy of it if `share`."""
    from lorasp_jax.extras.serving import loading
    from lorasp_jax.extras.serving.adapters import Bases

    where = {"base": options.base, "words": options.tokenizer, "dataset": options.dataset}
    bases = Bases(any_base=options.any_base)

    def load(run: str, *, start: bool = False) -> Any:
        own = not share or (start and not bases.can_share(run, options.base))
        model = None if own else functools.partial(bases.sampler, load=start)
        return compiled(loading.load_run(run, **where, model=model, any_base=options.any_base))

    # One at a time, as the prepared weights are copies.
    return {n: load(run, start=True) for n, run in named.items()}, load if share else None


def _checkpoint(
    options: argparse.Namespace, where: str, compiled: Callable[[Any], Any], share: bool
) -> tuple[dict[str, Any], Callable[[str], Any] | None]:
    """Load a published checkpoint and its adapters."""
    from lorasp_jax.extras.serving import loading

    names = ("tokenizer", "statistics", "dataset", "dtype", *UNSAID)
    chosen = {name: getattr(options, name) for name in names}
    if options.prompt_state:
        chosen["prompt_state"] = options.prompt_state == "yes"
    loaded = loading.load_checkpoint(
        where,
        **{name: value for name, value in chosen.items() if value is not None},
        cameras=dict(options.camera),
        adapters=dict(options.adapter),
        any_base=options.any_base,
        share=share,
    )
    first = loaded[loading.UNADAPTED]
    policies = {name: compiled(each) for name, each in loaded.items()}
    if not share:
        return policies, None
    return policies, lambda folder: compiled(first.with_adapters(folder, options.any_base))


def _refuse(options: argparse.Namespace, names: Sequence[str], reason: str) -> None:
    """Raise ValueError if one of these options was given, since it would have no effect."""
    for name in names:
        if getattr(options, name) not in (None, "", []):
            raise ValueError(f"--{name.replace('_', '-')} {reason}")


def _read_token(path: Path | None, console: Console) -> str:
    """Read the token, without a final newline, or write a fresh one; nobody else may read it."""
    if path is None:
        return ""
    with contextlib.suppress(FileExistsError), open(path, "x", opener=_privately) as file:
        file.write(secrets.token_urlsafe() + "\n")
        _say(console, f"wrote a fresh token to {path}")
    # systemd guards its credentials by access lists, whose mask is where a group's rights would be.
    guarded = str(path.parent) == os.environ.get("CREDENTIALS_DIRECTORY")
    if path.stat().st_mode & 0o077 and not guarded:
        try:
            path.chmod(0o600)
            _say(console, f"{path} was open to other users, and is so no more (mode 0600)")
        except OSError as error:  # such as a container's secret, which belongs to root
            _say(console, f"warning: other users can read {path}: {error.strerror}")
    token = path.read_text().strip()
    if not token or not token.isascii() or not token.isprintable():
        raise ValueError(f"{path} must contain a token of printable ASCII characters")
    return token


def _privately(path: str, flags: int) -> int:
    return os.open(path, flags, 0o600)


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, highlight=False, markup=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
