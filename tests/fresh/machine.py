"""Fresh machines: bare Debian in a chroot, where a newcomer clones the repository and types README's commands.

what is there of the machine   the kernel, its network, and what pip is told: its configuration and its variables
what is its own                files, /tmp, /dev and /dev/shm in memory, mounts, processes, shared memory, name

Root has the capabilities there that containers usually grant; so it cannot mount, load modules, or touch the network's
configuration. When the first process ends, however it ends, the kernel ends all others, and mounts and files are gone.
"""

from __future__ import annotations

import ast
import configparser
import os
import re
import shlex
import subprocess
import sys
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from tests.debian import IN_NAMESPACES, ROOT, base, debian_mirror, require_memory
from tests.privileged import CannotRun, run, tried

PACKAGES = {"debootstrap": "debootstrap"}
"""Command → the Debian package that has it."""
COMMANDS = ("make demo", "make test")
"""What README tells a newcomer to type."""
SECONDS = 3600.0
"""How long all commands together may take."""
_NEEDED_KILOBYTES = 6_000_000
_NEEDS = ("python3", "python3-venv", "make", "git", "ca-certificates")
_COMPILER = ("gcc", "libc6-dev", "python3-dev")

_CAPABILITIES = (
    *("chown", "dac_override", "fowner", "fsetid", "kill", "setgid", "setuid", "setpcap", "net_bind_service"),
    *("net_raw", "sys_chroot", "audit_write", "setfcap"),
)
_RUN = """
set -eu
system=$1 tar=$2 given=$3 user=$4 caps=$5
shift 5
mount -t tmpfs -o size=8g,mode=755 tmpfs "$system"
tar -C "$system" -xf "$tar"
mount -t proc proc "$system/proc"
mount -t sysfs -o ro sys "$system/sys"
mkdir -p "$system/dev/pts" "$system/dev/shm"
mount -t devpts -o newinstance,ptmxmode=0666,mode=620,gid=5 devpts "$system/dev/pts"
ln -sf pts/ptmx "$system/dev/ptmx"
mount -t tmpfs -o mode=1777,nosuid,nodev shm "$system/dev/shm"
hostname fresh
echo '127.0.0.1 localhost fresh' >"$system/etc/hosts"
cp -L /etc/resolv.conf "$system/etc/resolv.conf"
cp "$given/pip.conf" "$system/etc/pip.conf"
cp "$given/variables" "$system/etc/newcomer-variables"
cp "$given/evedrop.bundle" "$system/evedrop.bundle"
while read -r path; do
  if [ -d "$path" ]; then mkdir -p "$system$path"; else mkdir -p "$system${path%/*}"; touch "$system$path"; fi
  mount --bind -o ro "$path" "$system$path"
done <"$given/shown"
id=0 home=/root
if [ "$user" != root ]; then chroot "$system" useradd --create-home "$user"; id=1000 home=/home/$user; fi

as_newcomer() {
  setpriv --bounding-set "$caps" --inh-caps=-all chroot --userspec="$id:$id" "$system" \
    env -i HOME="$home" USER="$user" PATH=/usr/local/bin:/usr/bin:/bin sh -c ". /etc/newcomer-variables; cd && $1" </dev/null
}
others() {
  for entry in /proc/[0-9]*; do
    if [ "$(readlink "$entry/root")" = "$system" ]; then tr '\\0' ' ' <"$entry/cmdline" | cut -c-200; fi
  done
}
as_newcomer 'git -c advice.detachedHead=false -c init.defaultBranch=main clone --quiet /evedrop.bundle evedrop'
for command in "$@"; do
  begun=$(date +%s) status=0
  as_newcomer "cd evedrop && $command" || status=$?
  printf 'ended\\t%s\\t%s\\t%s\\n' "$status" "$(($(date +%s) - begun))" "$command" >>"$given/result"
done
tries=0
while [ -n "$(others)" ] && [ $tries -lt 50 ]; do sleep 0.2; tries=$((tries + 1)); done
# Zenoh removes the files of dead processes in /dev/shm when the next session opens, and pytest keeps its folders.
{
  others
  ls -A "$system/dev/shm" | grep -v '^[0-9]*[.]zenoh$'
  ls -A "$system/tmp" | grep -v '^pytest-of-'
} | sort -u | while read -r name; do
  printf 'left\\t%s\\n' "$name" >>"$given/result"
done
printf 'used\\t%s\\n' "$(df --output=used -k "$system" | tail -1)" >>"$given/result"
"""
"""Arguments: an empty folder, the tar, the folder with what the machine is given, user, capabilities, commands."""


@dataclass(frozen=True)
class Machine:
    """A bare Debian, and who uses it."""

    name: str
    release: str
    packages: tuple[str, ...]
    user: str


@dataclass(frozen=True)
class Outcome:
    """What became of a newcomer's commands; ended: command → status and seconds."""

    ended: Mapping[str, tuple[int, int]]
    left: tuple[str, ...]
    """What is there after the last command: the command lines of processes, the names of files in /tmp and in /dev/shm."""
    lines: tuple[str, ...]
    used_kilobytes: int

    def mistakes(self, commands: tuple[str, ...]) -> list[str]:
        """All that is not as README promises, in words."""
        mistakes = [f"`{command}` did not end" for command in commands if command not in self.ended]
        mistakes += [f"`{command}` ended with {status}" for command, (status, _) in self.ended.items() if status]
        # And why each test failed: the summary of pytest, 80 columns wide, has no room for that.
        mistakes += [line for line in self.lines if re.match(r"(FAILED|ERROR) \S+\.py\b|E   ", line)]
        return mistakes + [f"left behind: {path}" for path in self.left]


# Root on one of each kind, and an ordinary user on the other.
MACHINES = {
    machine.name: machine
    for machine in (
        Machine("debian12", "bookworm", _NEEDS, "newcomer"),
        Machine("debian12-cc", "bookworm", (*_NEEDS, *_COMPILER), "root"),
        Machine("debian13", "trixie", _NEEDS, "root"),
        Machine("debian13-cc", "trixie", (*_NEEDS, *_COMPILER), "newcomer"),
    )
}


def chosen(which: str) -> list[Machine]:
    """The machines that a name stands for: one, `all`, or `in-turn`, which is another one with every commit.

    Raises ValueError if there is none of that name.
    """
    machines = list(MACHINES.values())
    if which == "all":
        return machines
    if which == "in-turn":
        commits = int(run("git", "-c", f"safe.directory={ROOT}", "rev-list", "--count", "HEAD", cwd=ROOT).stdout)
        return [machines[commits % len(machines)]]
    if which not in MACHINES:
        raise ValueError(f"there is no fresh machine {which!r}; expected one of {', '.join(MACHINES)}, all, in-turn")
    return [MACHINES[which]]


def outcome(
    machine: Machine,
    folder: Path,
    write: Callable[[str], object],
    commands: tuple[str, ...] = COMMANDS,
    seconds: float = SECONDS,
) -> Outcome:
    """Clone this checkout's last commit on a fresh machine, and run commands there one after another.

    folder: for what is temporary; write: gets each line that is said there. Raises CannotRun.
    """
    require_memory(_NEEDED_KILOBYTES, "a fresh machine")
    tar = base(folder, debian_mirror(), machine.release, machine.packages)
    system, given = folder / "system", folder / "given"
    system.mkdir()
    given.mkdir()
    what_pip_is_told(given)
    bundle = ("bundle", "create", "--quiet", given / "evedrop.bundle", "HEAD")
    tried("git", "-c", f"safe.directory={ROOT}", *bundle, subject="git bundle", cwd=ROOT)
    bounding = ",".join(("-all", *(f"+{name}" for name in _CAPABILITIES)))
    words = (system, tar, given, machine.user, bounding, *commands)
    printed = _said([*IN_NAMESPACES, "--ipc", "--uts", "sh", "-c", _RUN, "sh", *map(str, words)], write, seconds)
    result = given / "result"
    lines = [line.split("\t") for line in result.read_text().splitlines()] if result.exists() else []
    if not lines:
        raise CannotRun(f"{machine.name} cannot be set up: {' '.join(printed[-20:])}")
    return Outcome(
        ended={line[3]: (int(line[1]), int(line[2])) for line in lines if line[0] == "ended"},
        left=tuple(line[1] for line in lines if line[0] == "left"),
        lines=tuple(printed),
        used_kilobytes=max((int(line[1]) for line in lines if line[0] == "used"), default=0),
    )


def _said(command: list[str], write: Callable[[str], object], seconds: float) -> list[str]:
    """The lines that a command says; it is killed after some seconds."""
    lines: list[str] = []
    with subprocess.Popen(
        command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, errors="replace"
    ) as process:
        limit = threading.Timer(seconds, process.kill)
        limit.start()
        try:
            assert process.stdout is not None
            for line in process.stdout:
                lines.append(line.rstrip("\n"))
                write(line)
        finally:
            limit.cancel()
            process.kill()
    return lines


def what_pip_is_told(folder: Path) -> None:
    """Write what pip needs where it cannot see this machine's files, so that it finds packages as it does here.

    In the folder are afterwards: `pip.conf`, this machine's configuration of pip as one file; `variables`, a shell script that
    exports each variable that concerns pip and the network; `shown`, the files and folders that these name.
    """
    listed = run(sys.executable, "-m", "pip", "config", "list").stdout.splitlines()
    settings = [line.split("=", 1) for line in listed if not line.startswith(":env:")]
    values = {name: " ".join(ast.literal_eval(value).split()) for name, value in settings}
    configuration = configparser.RawConfigParser()
    for name, value in values.items():
        section, key = name.split(".", 1)
        configuration.read_dict({section: {key: value}})
    with (folder / "pip.conf").open("w") as file:
        configuration.write(file)
    concerned = re.compile(r"PIP_\w+|(https?|no|all)_proxy|SSL_CERT_FILE|REQUESTS_CA_BUNDLE", re.IGNORECASE)
    variables = {name: value for name, value in os.environ.items() if concerned.fullmatch(name)}
    (folder / "variables").write_text(
        "".join(f"export {name}={shlex.quote(value)}\n" for name, value in variables.items())
    )
    words = {word for value in (*values.values(), *variables.values()) for word in value.split()}
    named = {word for word in words if word.startswith("/")}
    # The files of a local index usually lie next to its pages.
    named |= {os.path.dirname(urlsplit(word).path.rstrip("/")) for word in words if word.startswith("file:///")}
    shown = sorted(path for path in named - {"/"} if Path(path).exists())
    (folder / "shown").write_text("".join(f"{path}\n" for path in shown))
