# Sourced by quickstart.sh, test.sh and site.sh. The current folder must be the repository.
# Usage: . tools/setup.sh; setup EXTRA

fail() {
    printf 'error: %s\n' "$*" >&2
    exit 1
}

step() {
    printf '\n== %s\n' "$*"
}

check_room() { # folder, free disk space needed in GB
    free=$(df -Pk "$1" | awk 'NR == 2 {print int($4 / 1048576)}')
    [ "$free" -ge "$2" ] || fail "only $free GB free on the disk of $1, $2 GB are needed"
}

setup() { # extra of the package to install into .venv: report, site or test
    base=${PYTHON:-python3}
    "$base" -c 'import sys, venv, ensurepip; sys.exit(sys.version_info < (3, 10))' 2>/dev/null ||
        fail "$base is no Python 3.10 or newer with venv (on Debian: apt-get install python3-venv); set PYTHON to the path of one"
    # shellcheck disable=SC2086
    command -v ${CXX:-c++ g++ clang++} >/dev/null ||
        fail "no C++ compiler: ${CXX:-c++, g++ or clang++}; install one (on Debian: apt-get install g++), or set CXX to its path"
    check_room "$PWD" 4
    if ! .venv/bin/python -c 'import pip' 2>/dev/null; then # missing, or made in part
        step "Making a virtual environment in .venv"
        "$base" -m venv --clear .venv || fail "could not make a virtual environment in $PWD/.venv"
    fi
    step "Installing the package and compiling the renderer (torch takes most of the time)"
    install=(.venv/bin/python -m pip install --quiet --disable-pip-version-check --constraint constraints.txt)
    if [ "$(uname)" = Linux ]; then # PyPI's torch brings gigabytes of CUDA
        "${install[@]}" --retries 0 --index-url https://download.pytorch.org/whl/cpu torch 2>/dev/null ||
            echo "The index of torch for CPUs cannot be reached; PyPI's torch is taken."
    fi
    "${install[@]}" ".[$1]" ||
        fail "the installation failed; see the messages above (often: no network, no compiler or no disk space)"
}
