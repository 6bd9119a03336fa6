#!/usr/bin/env bash
# setup.sh [demo|test]: brings a fresh Debian or Ubuntu machine to where `make demo` or `make test` runs.
# Packages are installed by apt when this runs as root or sudo asks for no password; else the line to type is
# printed. Python packages go to .venv at the releases that requirements.txt pins. When all is there already, it
# says nothing, needs no network and takes no time. Variable: PYTHON, the interpreter that makes .venv.
# Status: 0 all is there, 1 something failed, 2 packages are missing and cannot be installed from here.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
PATH=$PATH:/usr/sbin:/sbin

purpose=${1:-test}
case $purpose in
demo | test) ;;
*)
    echo "usage: tools/setup.sh [demo|test]" >&2
    exit 1
    ;;
esac

say() { echo "setup: $*"; }
fail() {
    echo "setup: $1" >&2
    exit "${2:-1}"
}
have() { command -v "$1" >/dev/null 2>&1; }

# --- Debian packages -------------------------------------------------------------------------------------------

missing=()  # packages without which it does not work
optional=() # packages without which some tests are skipped
need() { have "$1" || missing+=("$2"); }

# True when this kernel carries CAN frames itself: a CAN interface exists, or the vcan driver can be loaded.
kernel_has_vcan() {
    local type
    for type in /sys/class/net/*/type; do
        [ ! -e "$type" ] || [ "$(cat "$type")" != 280 ] || return 0 # 280: ARPHRD_CAN
    done
    [ -d /sys/module/vcan ] || { have modprobe && modprobe --dry-run --quiet vcan 2>/dev/null; }
}

need gcc gcc
need make make
need cmake cmake
if have gcc && ! echo '#include <stdio.h>' | gcc -E - >/dev/null 2>&1; then
    missing+=(libc6-dev)
fi
have gcc || missing+=(libc6-dev)
if have cmake; then
    cmake_version=$(cmake --version | sed -n -E '1s/[^0-9]*([0-9.]+).*/\1/p')
    [ "$(printf '%s\n' 3.22 "$cmake_version" | sort -V | head -n 1)" = 3.22 ] ||
        fail "cmake is $cmake_version, 3.22 or later is needed (Debian 12, Ubuntu 22.04 and later have it)"
fi

python=${PYTHON:-python3}
if ! have "$python"; then
    [ "$python" = python3 ] || fail "PYTHON=$python is no command"
    missing+=(python3 python3-venv)
else
    "$python" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
        fail "$python is $("$python" --version 2>&1), 3.10 or later is needed; if you have one: PYTHON=python3.12 make setup"
    # ensurepip is the part of venv that Debian packages separately, per Python release
    if [ ! -x .venv/bin/python ] && ! "$python" -c 'import ensurepip, venv' 2>/dev/null; then
        if [ "$python" = python3 ]; then
            missing+=(python3-venv)
        else
            missing+=("$("$python" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])')")
        fi
    fi
fi

if [ "$purpose" = test ]; then
    need clang clang
    # libFuzzer: on some releases in a package of its own, named after clang's release
    fuzz_nothing='int LLVMFuzzerTestOneInput(const char *d, unsigned long n) { return d == 0 && n > 0; }'
    if ! have clang; then
        ! apt-cache show libclang-rt-dev >/dev/null 2>&1 || missing+=(libclang-rt-dev)
    elif ! echo "$fuzz_nothing" | clang -fsanitize=fuzzer -x c -o /dev/null - 2>/dev/null; then
        missing+=("libclang-rt-$(clang -dumpversion | cut -d . -f 1)-dev")
    fi
    need cppcheck cppcheck
    # headers and libraries for gcc -m32, for PCs only
    if [ "$(uname -m)" = x86_64 ] && ! echo '#include <stdio.h>' | gcc -m32 -E - >/dev/null 2>&1; then
        missing+=(gcc-multilib)
    fi
    need candump can-utils
    need ip iproute2
    # the page of tools/live.py is tested in a browser; Ubuntu's package of this name only leads to a snap
    have chromium || have chromium-browser || have google-chrome || optional+=(chromium)
    need arm-none-eabi-gcc gcc-arm-none-eabi
    need qemu-system-arm qemu-system-arm
    # A Linux kernel as a program, with the vcan driver; exists for PCs only.
    case $(uname -m) in
    x86_64 | i?86) have linux.uml || kernel_has_vcan || optional+=(user-mode-linux) ;;
    esac
fi

if [ ${#optional[@]} -gt 0 ]; then
    note=.venv/setup-without
    if [ "$(cat "$note" 2>/dev/null)" = "${optional[*]}" ]; then
        optional=() # tried before, in vain; said before
    fi
fi

root=()
can_install=no
if have apt-get; then
    if [ "$(id -u)" = 0 ]; then
        can_install=yes
    elif have sudo && sudo -n true 2>/dev/null; then
        can_install=yes
        root=(sudo -n)
    fi
fi
apt() { "${root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -o Dpkg::Use-Pty=0 "$@"; }

if [ ${#missing[@]} -gt 0 ] || { [ ${#optional[@]} -gt 0 ] && [ $can_install = yes ]; }; then
    if [ $can_install = no ]; then
        say "missing: ${missing[*]}" >&2
        if have apt-get; then
            fail "not root, and sudo asks for a password; please type
    sudo apt-get update && sudo apt-get install --no-install-recommends ${missing[*]} ${optional[*]}" 2
        fi
        fail "no apt-get here; please install these with your system's package manager (the names are Debian's)" 2
    fi
    say "installing Debian packages: ${missing[*]} ${optional[*]}"
    apt update || say "apt-get update failed; trying with the package lists that are here"
    if [ ${#missing[@]} -gt 0 ]; then
        apt install -y --no-install-recommends "${missing[@]}" || fail "apt-get failed; please type
    sudo apt-get update && sudo apt-get install --no-install-recommends ${missing[*]}
and see what it says"
    fi
fi
if [ ${#optional[@]} -gt 0 ]; then
    if [ $can_install = no ] || ! apt install -y --no-install-recommends "${optional[@]}"; then
        say "without ${optional[*]}: the tests that need them (a CAN interface, a browser) are skipped; to have them:"
        say "    sudo apt-get install --no-install-recommends ${optional[*]}"
        without=${optional[*]}
    fi
fi

# --- Python packages -------------------------------------------------------------------------------------------

if ! .venv/bin/python -c '' 2>/dev/null; then
    say "making .venv with $("$python" --version)"
    "$python" -m venv --clear .venv || fail "no .venv could be made; the lines above say why"
fi
stamp=.venv/setup-stamp
state="$(sha256sum <requirements.txt | cut -d ' ' -f 1) $(.venv/bin/python --version)"
if [ "$(cat $stamp 2>/dev/null)" != "$state" ]; then
    say "installing Python packages into .venv"
    .venv/bin/python -m pip install --quiet --disable-pip-version-check --requirement requirements.txt ||
        fail "pip failed; please type
    .venv/bin/python -m pip install --requirement requirements.txt
and see what it says"
    echo "$state" >$stamp
fi
[ -z "${without:-}" ] || echo "$without" >.venv/setup-without
