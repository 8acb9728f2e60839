"""Serve a policy: `python -m lorasp_jax.extras.serving runs/NAME`."""

import argparse
import asyncio
import functools
import secrets
import signal
import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rich.console import Console

from lorasp_jax.base.arguments import indices, pair, positive
from lorasp_jax.base.errors import run_command

UNSAID = ("openpi_config", "size", "chunk", "relative", "prompt_state", "joints", "action_length")
"""Options that say what the files of a published checkpoint do not; see `checkpoint.Unsaid`."""
CHECKPOINT_OPTIONS = ("statistics", "dataset", "dtype", "camera", "adapter", *UNSAID)
"""Options for published checkpoints."""


def main(arguments: Sequence[str], program: str = "python -m lorasp_jax.extras.serving") -> int:
    """Serve until SIGINT or SIGTERM; return the exit code, one of `lorasp_jax.base.errors`."""
    options = parser(program).parse_args(arguments)
    console = Console(stderr=True)
    return run_command(lambda: _serve(options, Console()), console)


def parser(program: str) -> argparse.ArgumentParser:
    """Return the argument parser of this command."""
    parser = argparse.ArgumentParser(
        prog=program,
        description="Serve a policy over websockets, in openpi's protocol or vla-eval's.",
        epilog="Pages on the same port: /healthz and /status. See docs/serving.md.",
    )
    add = parser.add_argument
    add(
        "policy",
        nargs="+",
        type=_named,
        metavar="[NAME=]POLICY",
        help="folder of a finished run or an exported policy, or a published checkpoint (folder, "
        "hf://owner/name or gs://bucket/folder). Several runs: requests choose by NAME, the first "
        "is the default",
    )
    add("--host", default="127.0.0.1", help="address to listen on; others than the default need a "
        "token (default: %(default)s)")  # fmt: skip
    add("--port", type=int, default=8000, help="default: %(default)s")
    add("--token-file", type=Path, metavar="FILE", help="file with the token of the clients")
    add("--prompt", default="", help="instruction of requests that have none")
    add("--max-batch", type=int, help="largest batch (default: 8)")
    add("--num-steps", type=int, help="flow steps (default: 10)")
    add("--seed", type=int, help="seed of the flow's noise, which repeats what a server answered "
        "(default: a fresh one, which is printed)")  # fmt: skip
    add(
        "--execution",
        default="naive",
        choices=("naive", "trained", "guided"),
        help="whether chunks can continue the previous one, as learned in training or by guidance "
        "(default: %(default)s); see docs/latency.md",
    )
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

    token = _read_token(options.token_file)
    if options.vla_eval:
        from lorasp_jax.extras.serving import vla_eval  # before what takes long

        _refuse(options, ("token_file",), "has no effect with --vla-eval")
        with server.bind(options.host, options.port) as port:
            policy_server = vla_eval.VlaEvalServer(_load(options, console), options.vla_eval)
            asyncio.run(_run(policy_server, port, console))
        return
    with server.bind(options.host, options.port, token=token) as port:  # before what takes long
        policy_server = server.PolicyServer(_load(options, console), token=token)
        asyncio.run(_run(policy_server, port, console))
    policy_server.close()


async def _run(policy_server: Any, port: socket.socket, console: Console) -> None:
    """Serve until SIGINT or SIGTERM."""
    stop = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    host, number = port.getsockname()[:2]
    host = f"[{host}]" if ":" in host else host
    async with policy_server.listen(port):
        _say(console, f"listening on ws://{host}:{number}")
        await stop.wait()
        _say(console, "closing connections")


def _load(options: argparse.Namespace, console: Console) -> Any:
    """Load and compile the policies, saying what takes long."""
    from lorasp_jax.base import compilation_cache as cache
    from lorasp_jax.extras.serving.exported import is_exported
    from lorasp_jax.extras.serving.served import ServedPolicies

    named, start = dict(options.policy), time.monotonic()
    if len(named) < len(options.policy):
        raise ValueError("the policies must have different names: pass NAME=POLICY")
    cache.enable()
    seed = secrets.randbelow(2**31) if options.seed is None else options.seed
    _say(console, f"loading {', '.join(named.values())} with --seed {seed}")
    policies = (_exported if all(map(is_exported, named.values())) else _compiled)(options, named)
    settings = {"prompt": options.prompt, "execution": options.execution}
    policy = ServedPolicies(policies, seed=seed, **settings)
    policy.warm_up(functools.partial(_say, console))
    _say(console, f"ready after {time.monotonic() - start:.0f} s")
    return policy


def _exported(options: argparse.Namespace, named: dict[str, str]) -> dict[str, Any]:
    """Load exported policies."""
    from lorasp_jax.extras.serving.exported import load

    settings = ("num_steps", "max_batch", "guidance", "base", "tokenizer", *CHECKPOINT_OPTIONS)
    _refuse(options, settings, "has no effect on exported policies")
    if options.execution == "guided":
        raise ValueError("exported policies cannot be guided: use --execution naive or trained")
    return {name: load(folder) for name, folder in named.items()}


def _compiled(options: argparse.Namespace, named: dict[str, str]) -> dict[str, Any]:
    """Load runs or a checkpoint."""
    from lorasp_jax.extras.serving import loading
    from lorasp_jax.extras.serving.policies import CompiledPolicy, batch_sizes
    from lorasp_jax.training.export import is_run

    if options.max_batch is not None:
        batch_sizes(options.max_batch)  # an invalid one is refused before what takes long
    given = {name: getattr(options, name) for name in ("num_steps", "max_batch")}
    settings = {name: value for name, value in given.items() if value is not None}
    if options.execution == "guided":
        settings["guidance"] = 10.0 if options.guidance is None else options.guidance
    compiled = functools.partial(CompiledPolicy, **settings)
    if all(map(is_run, named.values())):
        others = [name for name in CHECKPOINT_OPTIONS if name != "dataset"]
        _refuse(options, others, "is for published checkpoints: runs record theirs")
        where = {"base": options.base, "words": options.tokenizer, "dataset": options.dataset}
        # One at a time, as the prepared weights are copies.
        return {name: compiled(loading.load_run(run, **where)) for name, run in named.items()}
    if len(named) > 1:
        raise ValueError("several policies must all be finished runs, or all be exported")
    _refuse(options, ("base",), "is for runs")
    names = ("tokenizer", "statistics", "dataset", "dtype", *UNSAID)
    chosen = {name: getattr(options, name) for name in names}
    if options.prompt_state:
        chosen["prompt_state"] = options.prompt_state == "yes"
    loaded = loading.load_checkpoint(
        *named.values(),
        **{name: value for name, value in chosen.items() if value is not None},
        cameras=dict(options.camera),
        adapters=dict(options.adapter),
    )
    return {name: compiled(each) for name, each in loaded.items()}


def _refuse(options: argparse.Namespace, names: Sequence[str], reason: str) -> None:
    """Raise ValueError if one of these options was given, since it would have no effect."""
    for name in names:
        if getattr(options, name) not in (None, "", []):
            raise ValueError(f"--{name.replace('_', '-')} {reason}")


def _named(text: str) -> tuple[str, str]:
    """Split NAME=POLICY; without a name, the last part of the path is the name."""
    if "=" not in text or Path(text).exists():  # a path may contain the character
        return Path(text).name, text
    return pair(text)


def _read_token(path: Path | None) -> str:
    """Read the token, without a final newline."""
    if path is None:
        return ""
    token = path.read_text().strip()
    if not token or not token.isascii() or not token.isprintable():
        raise ValueError(f"{path} must contain a token of printable ASCII characters")
    return token


def _say(console: Console, text: str) -> None:
    console.print(text, soft_wrap=True, highlight=False, markup=False)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
