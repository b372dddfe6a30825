"""Confine a process to what a decoder needs: to compute, to read libraries, and to use files that are open already.

Two parts of Linux do it, for good and for all threads started later. Landlock refuses every file but those below the
libraries' folders, for reading. seccomp refuses every system call but some that act on the process itself and on its
open files: there is no network, no new process, no signal to another process and no look into one. No library on PyPI
does both, so the calls are made here. Numbers come from the headers of Linux, named at each.
"""

import ctypes
import errno
import os
import platform
import struct
import sys
import sysconfig
from pathlib import Path

# linux/landlock.h, and asm-generic/unistd.h, whose numbers of these calls all architectures share
_LANDLOCK_CREATE_RULESET, _LANDLOCK_ADD_RULE, _LANDLOCK_RESTRICT_SELF = 444, 445, 446
_LANDLOCK_CREATE_RULESET_VERSION = 1
_LANDLOCK_RULE_PATH_BENEATH = 1
_READ_FILE, _READ_DIR = 1 << 2, 1 << 3
_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}  # how many rights a version knows
_RIGHTS_NOW = 16
# linux/prctl.h
_PR_SET_PDEATHSIG, _PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS = 1, 22, 38
# linux/seccomp.h
_SECCOMP_MODE_FILTER = 2
_SECCOMP_GET_ACTION_AVAIL = 2
_KILL, _ERRNO, _ALLOW = 0x80000000, 0x00050000, 0x7FFF0000
_NUMBER_AT, _MACHINE_AT, _ARGUMENT_AT = 0, 4, 16  # in struct seccomp_data; the first argument's lower half
# linux/bpf_common.h
_LOAD, _IF_EQUAL, _IF_SET, _RETURN = 0x20, 0x15, 0x45, 0x06
# linux/sched.h
_CLONE_THREAD = 0x00010000

_MACHINES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}
"""Columns of the tables below, and AUDIT_ARCH of linux/audit.h."""
_CALLS = """
    read 0 63, write 1 64, readv 19 65, writev 20 66, pread64 17 67, close 3 57, fstat 5 80,
    newfstatat 262 79, statx 332 291, lseek 8 62, openat 257 56, getdents64 217 61, readlinkat 267 78,
    getcwd 79 17, dup3 292 24, faccessat 269 48, faccessat2 439 439, fadvise64 221 223, mmap 9 222,
    mprotect 10 226, munmap 11 215, mremap 25 216, madvise 28 233, brk 12 214, membarrier 324 283,
    futex 202 98, set_robust_list 273 99, rseq 334 293, set_tid_address 218 96, sched_yield 24 124,
    getcpu 309 168, sched_getaffinity 204 123, exit 60 93, exit_group 231 94, rt_sigaction 13 134,
    rt_sigprocmask 14 135, rt_sigreturn 15 139, sigaltstack 131 132, restart_syscall 219 128,
    clock_gettime 228 113, clock_getres 229 114, clock_nanosleep 230 115, nanosleep 35 101,
    gettimeofday 96 169, getpid 39 172, gettid 186 178, getuid 102 174, geteuid 107 175, getgid 104 176,
    getegid 108 177, getrandom 318 278, getrusage 98 165, sysinfo 99 179, uname 63 160
"""
CALLS = {name: (int(x86), int(arm)) for name, x86, arm in map(str.split, _CALLS.split(","))}
"""System calls that a decoder may make, by asm/unistd_64.h of x86_64 and asm-generic/unistd.h of aarch64."""
LEGACY = {
    "stat": 4,
    "dup2": 33,
    "lstat": 6,
    "access": 21,
    "readlink": 89,
    "getdents": 78,
    "time": 201,
    "poll": 7,
}
"""The same for older calls, which x86_64 alone has."""
LIMITED = {"clone": (56, 220), "prlimit64": (302, 261), "clone3": (435, 435), "seccomp": (317, 277)}
"""Calls that depend on an argument, or that this module makes."""


def missing() -> str | None:
    """What this machine lacks to confine decoders, as a sentence with the remedy; None if it lacks nothing."""
    lacking = []
    if not _landlock_version():
        lacking.append("Landlock (Linux 5.13), so they can read and write files of the service")
    if not _has_seccomp():
        lacking.append(
            "seccomp on x86-64 or ARM64, so they can use the network, and start and disturb processes"
        )
    if not lacking:
        return None
    return (
        f"decoders of untrusted files are not confined on this machine: it lacks {'; and '.join(lacking)}. Use a "
        "kernel, and a container's profile, that allow them, or take files from people you trust only"
    )


def confine() -> None:
    """Confine this process, as far as the machine can. There is no way back.

    Only the calling thread and those that it starts are confined: call it while there is one.

    Raises
    ------
    OSError
        If the machine refuses what it offers.
    """
    version = _landlock_version()
    seccomp = _has_seccomp()
    if version or seccomp:
        _prctl(_PR_SET_NO_NEW_PRIVS, 1)  # without it both need privileges
    if version:
        _restrict_files((1 << _RIGHTS.get(version, _RIGHTS_NOW)) - 1)
    if seccomp:
        _restrict_calls()


def end_with_parent(signal: int) -> None:
    """Have the kernel send a signal to this process when its parent ends; on Linux only."""
    if sys.platform == "linux":
        _prctl(_PR_SET_PDEATHSIG, signal)


def _libraries() -> set[Path]:
    """Where Python and libraries find what they load while they run. The working folder is not among them."""
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    own = Path(__file__).parents[1]
    system = ("/lib", "/lib64", "/usr/lib", "/usr/lib64", "/usr/local/lib", "/etc/ld.so.cache")
    return {
        own,
        own.with_name("storage"),
        *(Path(sysconfig.get_path(name)) for name in names),
        *map(Path, system),
    }


def _restrict_files(rights: int) -> None:
    """Allow reading below the folders of libraries, and no other use of files that are not open."""
    attributes = struct.pack("=Q", rights)  # struct landlock_ruleset_attr, its first field
    rules = _call(_LANDLOCK_CREATE_RULESET, attributes, len(attributes), 0)
    try:
        for path in _libraries():
            if not path.exists():
                continue
            beneath = os.open(path, os.O_PATH | os.O_CLOEXEC)
            allowed = _READ_FILE | _READ_DIR if path.is_dir() else _READ_FILE
            rule = struct.pack("=Qi", allowed, beneath)  # struct landlock_path_beneath_attr
            try:
                _call(_LANDLOCK_ADD_RULE, rules, _LANDLOCK_RULE_PATH_BENEATH, rule, 0)
            finally:
                os.close(beneath)
        _call(_LANDLOCK_RESTRICT_SELF, rules, 0)
    finally:
        os.close(rules)


def _restrict_calls() -> None:
    """Refuse all system calls but those that a decoder needs."""
    column, machine = _MACHINES[platform.machine()]
    limited = {name: numbers[column] for name, numbers in LIMITED.items()}
    allowed = [numbers[column] for numbers in CALLS.values()]
    if column == 0:
        allowed += LEGACY.values()
    # Each line: code, lines to skip if true, if false, operand (struct sock_filter of linux/filter.h).
    program = [(_LOAD, 0, 0, _MACHINE_AT), (_IF_EQUAL, 1, 0, machine), (_RETURN, 0, 0, _KILL)]
    program += [(_LOAD, 0, 0, _NUMBER_AT)]
    for number in allowed:
        program += [(_IF_EQUAL, 0, 1, number), (_RETURN, 0, 0, _ALLOW)]
    # Its flags are in memory, where no filter looks: the C library uses clone in its place.
    program += [(_IF_EQUAL, 0, 1, limited["clone3"]), (_RETURN, 0, 0, _ERRNO | errno.ENOSYS)]
    # Threads, but no processes; limits of this process (0), but of no other.
    for name, condition, operand in (("clone", _IF_SET, _CLONE_THREAD), ("prlimit64", _IF_EQUAL, 0)):
        program += [
            (_IF_EQUAL, 0, 4, limited[name]),
            (_LOAD, 0, 0, _ARGUMENT_AT),
            (condition, 0, 1, operand),
            (_RETURN, 0, 0, _ALLOW),
            (_RETURN, 0, 0, _ERRNO | errno.EPERM),
        ]
    program += [(_RETURN, 0, 0, _ERRNO | errno.EPERM)]
    lines = ctypes.create_string_buffer(b"".join(struct.pack("=HBBI", *line) for line in program))
    filter_ = struct.pack("@HP", len(program), ctypes.addressof(lines))  # struct sock_fprog
    _prctl(_PR_SET_SECCOMP, _SECCOMP_MODE_FILTER, filter_)


def _landlock_version() -> int:
    """The version of Landlock's interface; 0 without it."""
    if sys.platform != "linux":
        return 0
    try:
        return _call(_LANDLOCK_CREATE_RULESET, None, 0, _LANDLOCK_CREATE_RULESET_VERSION)
    except OSError:  # the kernel lacks it, or it is switched off
        return 0


def _has_seccomp() -> bool:
    if sys.platform != "linux" or platform.machine() not in _MACHINES or sys.maxsize < 1 << 32:
        return False
    column, _ = _MACHINES[platform.machine()]
    try:
        _call(LIMITED["seccomp"][column], _SECCOMP_GET_ACTION_AVAIL, 0, struct.pack("=I", _ERRNO))
    except OSError:
        return False
    return True


def _prctl(option: int, *arguments: int | bytes) -> None:
    """prctl(2), whose unused arguments must be 0."""
    padded = [*arguments, 0, 0, 0][:4]
    _checked(ctypes.CDLL(None, use_errno=True).prctl(option, *map(_as_long, padded)))


def _call(number: int, *arguments: int | bytes | None) -> int:
    """syscall(2)."""
    library = ctypes.CDLL(None, use_errno=True)
    return _checked(library.syscall(ctypes.c_long(number), *map(_as_long, arguments)))


def _as_long(argument: int | bytes | None) -> object:
    return ctypes.c_ulong(argument) if isinstance(argument, int) else argument


def _checked(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result
