# Sourced by quickstart.sh, test.sh and site.sh: checks the machine, makes a virtual environment in .venv and installs the package.
# Usage: . tools/setup.sh; setup EXTRA
# Sets $python to the environment's interpreter. The current folder must be the repository.

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

step() {
    printf '\n== %s\n' "$*"
}

check_machine() { # free disk space needed, in GB
    base=${PYTHON:-python3}
    command -v "$base" >/dev/null || fail "no $base found; install Python 3.10 or newer, or set PYTHON to its path"
    "$base" -c 'import sys; sys.exit(sys.version_info < (3, 10))' ||
        fail "Python 3.10 or newer is needed, $base is $("$base" --version 2>&1); set PYTHON to a newer one"
    "$base" -c 'import venv, ensurepip' 2>/dev/null ||
        fail "$base cannot make virtual environments; install its venv package (on Debian: apt-get install python3-venv)"
    if [ -n "${CXX:-}" ]; then
        command -v "$CXX" >/dev/null || fail "CXX is set to $CXX, which is not there; unset CXX or set it to a C++ compiler"
    else
        command -v c++ >/dev/null || command -v g++ >/dev/null || command -v clang++ >/dev/null ||
            fail "no C++ compiler found; install one (on Debian: apt-get install g++), or set CXX to its path"
    fi
    [ -w . ] || fail "cannot write to $PWD; clone the repository to a folder of your own"
    check_room "$PWD" "$1" ""
}

check_room() { # folder, free disk space needed in GB, further advice
    free=$(df -Pk "$1" | awk 'NR == 2 {print int($4 / 1048576)}')
    [ "$free" -ge "$2" ] || fail "only $free GB free on the disk of $1, $2 GB are needed; free some space$3"
}

setup() { # extra of the package to install: report, site or test
    check_machine 4
    python=$PWD/.venv/bin/python
    if ! "$python" -c '' 2>/dev/null; then
        step "Making a virtual environment in .venv"
        "$base" -m venv --clear .venv || fail "could not make a virtual environment in $PWD/.venv"
    fi
    step "Installing the package and compiling the renderer (torch takes most of the time)"
    "$python" -m pip install --quiet --disable-pip-version-check --constraint constraints.txt ".[$1]" ||
        fail "the installation failed; see the messages above (often: no network, no compiler or no disk space)"
    "$python" -I -c 'import nmr' || fail "the package was installed but cannot be imported"
}
