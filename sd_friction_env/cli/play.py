"""To look at, to listen to and to play with: ``sd-friction explore``, ``video`` and ``listen``."""

import argparse
import math
from pathlib import Path

import numpy as np

from sd_friction_env.cli.agents import AGENTS_TEXT, agent_of, title_of
from sd_friction_env.cli.options import (
    Command,
    UsageError,
    add_environment,
    add_oscillator,
    check_at_least,
    check_file,
    environment_of,
    one_of,
    progress_bar,
)
from sd_friction_env.control import sound
from sd_friction_env.environments.ids import TASKS, environment_id
from sd_friction_env.environments.single import make_env
from sd_friction_env.physics import signals
from sd_friction_env.physics.parameters import checked_number
from sd_friction_env.pictures.scene import checked_size


def _explore(options: argparse.Namespace) -> int:
    from sd_friction_env.explorer import server as explorer

    if not 0 <= options.port <= 65535:
        raise UsageError(f"--port must be in [0, 65535], got {options.port}")
    if not options.host or ":" in options.host:
        raise UsageError(f"--host must be a name or an IPv4 address, got {options.host!r}")
    if not 1 <= options.sessions <= explorer.MOST_SESSIONS:
        raise UsageError(f"--sessions must be in [1, {explorer.MOST_SESSIONS}], got {options.sessions}")
    try:
        explorer.serve(
            options.host,
            options.port,
            allowed=options.allow_host,
            sessions=options.sessions,
            browser=not options.no_browser,
            say=_say,
        )
    except OSError as error:
        raise UsageError(f"cannot listen at --host {options.host} --port {options.port}: {error}") from None
    return 0


def _say(text: str) -> None:
    print(text, flush=True)


def _video(options: argparse.Namespace) -> int:
    from sd_friction_env.control import video

    for name, low, high in (("steps", 1, video.MOST_STEPS), ("every", 1, video.MOST_STEPS), ("fps", 1, 60)):
        if not low <= getattr(options, name) <= high:
            raise UsageError(f"--{name} must be in [{low}, {high}], got {getattr(options, name)}")
    check_at_least(options, seed=0)
    video.check_video_path(options.out, options.fps)
    width, height = checked_size(options.size)
    if options.out.suffix.lower() == ".mp4" and (width % 2 or height % 2):
        raise UsageError(f"--size must be even for .mp4, got {width} {height}")
    env_id = environment_of(options)
    policy = agent_of(options.agent, env_id, gain=options.gain)
    pictures = video.frames(
        env_id,
        policy,
        seed=options.seed,
        steps=options.steps,
        size=tuple(options.size),
        every=options.every,
        side_by_side=not options.alone,
        title=title_of(options.agent, policy),
    )
    show = progress_bar(options.steps // options.every + 1, "frames")
    video.write_video(options.out, pictures, fps=options.fps, progress=show)
    return 0


def _add_explore(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--port", type=int, default=5006, help="0: any that is free (default: 5006)")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen at (default: this machine only)")
    text = "serve it under these names too, of a proxy or a forwarded port (default: its address and localhost alone)"
    parser.add_argument("--allow-host", nargs="+", default=[], metavar="NAME[:PORT]", help=text)
    parser.add_argument("--sessions", type=int, default=8, metavar="N", help="pages at a time (default: 8)")
    parser.add_argument("--no-browser", action="store_true", help="open no browser, print the address")


def _add_video(parser: argparse.ArgumentParser) -> None:
    add_environment(parser, arguments=False)
    text = f"{AGENTS_TEXT} (default: pretrained)"
    parser.add_argument("--agent", default="pretrained", metavar="AGENT", help=text)
    parser.add_argument("--gain", type=float, help="of velocity-feedback (default: 1.5 on force, 1 on belt)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="FILE.mp4 or FILE.gif")
    parser.add_argument("--seed", type=int, default=0, help="of the episode (default: 0)")
    parser.add_argument("--steps", type=int, default=300, help="control intervals (default: 300)")
    text = "of one picture, in pixels (default: 960 540)"
    parser.add_argument("--size", nargs=2, type=int, default=[960, 540], metavar=("WIDTH", "HEIGHT"), help=text)
    parser.add_argument("--every", type=int, default=1, metavar="N", help="a frame every N intervals (default: 1)")
    parser.add_argument("--fps", type=int, default=30, help="frames a second, 1 to 60 (GIF: to 50; default: 30)")
    parser.add_argument("--alone", action="store_true", help="without the passive oscillator beside it")


LISTEN_TEXT = """\
Writes the velocity of the mass as sound: the passive limit cycle, then the same motion under control. An oscillator of
a rig (--rig) is played at its own frequency if that is audible, any other at 440 Hz, or at --pitch. Levels below
-120 dB are printed as -120 dB."""


def _add_listen(parser: argparse.ArgumentParser) -> None:
    add_oscillator(parser)
    parser.add_argument("--task", choices=TASKS, default="belt", help="actuator (default: belt)")
    text = f"{AGENTS_TEXT} (default: threshold-follower by the belt, velocity-feedback by force)"
    parser.add_argument("--agent", metavar="AGENT", help=text)
    parser.add_argument("--gain", type=float, help="of velocity-feedback (default: 1.5 on force, 1 on belt)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.wav", help="file to write")
    parser.add_argument("--pitch", type=float, metavar="HZ", help="frequency of the squeal in the sound")
    parser.add_argument("--seconds", type=float, default=1.0, help="of each part (default: 1)")
    parser.add_argument("--rate", type=int, default=44_100, help="samples a second (default: 44100)")


def _listen(options: argparse.Namespace) -> int:
    check_file("--out", options.out, ".wav")
    parameters = one_of(options)
    pitch = sound.pitch_of(parameters, options.pitch)
    env_id = environment_id(options.task)
    seconds = checked_number("seconds", options.seconds, *sound.SECONDS)
    steps = 2 + math.ceil(seconds / pitch.unit / make_env(env_id).task.control_interval)
    env_kwargs = {"parameters": parameters, "episode_steps": max(steps, 1)}
    name = options.agent or ("threshold-follower" if options.task == "belt" else "velocity-feedback")
    policy = agent_of(name, env_id, gain=options.gain, env_kwargs=env_kwargs)
    env = make_env(env_id, env_kwargs)
    before, after = sound.squeal(env, policy, pitch, seconds=seconds, rate=options.rate)
    sound.write_sound(options.out, np.concatenate([before, after]), options.rate)
    heard = signals.harmonics(before, 1.0 / options.rate, count=1)["frequency"][0]
    own = "" if math.isnan(pitch.own) else f", on the rig {pitch.own:.6g} Hz"
    print(f"one dimensionless unit of time is {pitch.unit:.6g} s of sound{own}")
    print(f"fundamental in the sound {heard:.4f} Hz, 1/T of the limit cycle {pitch.played:.4f} Hz")
    loud, quiet = (float(np.std(part[len(part) // 2 :])) for part in (before, after))
    print(f"level under control, last half: {20.0 * math.log10(max(quiet / loud, 1e-6)):.1f} dB of the squeal's")
    return 0


COMMANDS = {
    "explore": Command(
        _add_explore,
        _explore,
        ["", "--port 8080 --no-browser", "--host 0.0.0.0 --allow-host oscillator.example.org --no-browser"],
    ),
    "video": Command(
        _add_video,
        _video,
        [
            "--task belt --out suppressed.mp4",
            "--task force --agent velocity-feedback --gain 1.5 --size 480 270 --every 3 --fps 10 --out small.gif",
            "--task belt --tier sensed --agent runs/mine --seed 3 --alone --out mine.mp4",
        ],
    ),
    "listen": Command(
        _add_listen,
        _listen,
        [
            "--out squeal.wav",
            "--task force --belt-speed 0.1 --pitch 880 --out high.wav",
            "--rig rig.toml --out rig.wav",
        ],
        LISTEN_TEXT,
    ),
}
