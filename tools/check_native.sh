#!/usr/bin/env bash
# Checks the kernels (csrc/) without Python, in separate builds under build/native. Usage: bash tools/check_native.sh CHECK [ARGUMENTS]
#   tests             C++ tests; every instruction set must give the same bits; every header compiles alone
#   asan, tsan        the same under AddressSanitizer and UndefinedBehaviorSanitizer; under ThreadSanitizer
#   fuzz SECONDS      libFuzzer looks for inputs that reach new code; keep stores them in corpus.hex
#   count             instructions of every kernel under callgrind, at most 5 % above instructions.json; --store stores
#                     new bounds. count-base: without AVX
#   variants          the same bits from each compiler and instruction set, arm64 under qemu included
#   coverage          lines and branches that the tests and the corpus reach
# Exit status 77: a tool is missing. PYTHON: an interpreter that has cmeel-eigen and gcovr; default .venv/bin/python.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-$PWD/.venv/bin/python}
PATH=$(dirname "$python"):$PATH # cmake and ninja of the test extra
export OMP_WAIT_POLICY=passive # there may be more threads than cores: do not spin
sanitize="-O1 -g -fno-omit-frame-pointer -fno-sanitize-recover=all -DNMR_FRESH_SCRATCH"
address="$sanitize -fsanitize=address,undefined,float-cast-overflow -D_GLIBCXX_ASSERTIONS"

want() { # program that the check needs
    command -v "$1" >/dev/null || { echo "skipped: the check needs $1, which is not installed"; exit 77; }
}

build() { # name, compiler, flags, targets, further cmake arguments
    local folder=build/native/$1 generator=()
    command -v ninja >/dev/null && generator=(-G Ninja)
    [[ $2 != aarch64* ]] || set -- "$@" -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64
    # shellcheck disable=SC2086
    cmake -S tests/csrc -B "$folder" "${generator[@]}" -DCMAKE_BUILD_TYPE=None -DPython_EXECUTABLE="$python" \
        -DCMAKE_CXX_COMPILER="$2" -DCMAKE_CXX_FLAGS="$3" "${@:5}" >"$folder.log" 2>&1 &&
        cmake --build "$folder" --parallel "${JOBS:-2}" --target $4 >>"$folder.log" 2>&1 ||
        { grep -E -A8 "error|Error|FAILED" "$folder.log" | head -60; echo "the whole log: $folder.log"; exit 1; }
}

build_and_run() { # name, compiler, flags, further cmake arguments
    build "$1" "$2" "$3" "tests fuzz workload" "${@:4}"
    "build/native/$1/tests"
    "build/native/$1/fuzz" tests/csrc/corpus.hex
}

check_tests() { # with the flags of the package
    build plain "${CXX:-c++}" -O3 headers -DNMR_MULTIVERSION=ON
    build_and_run plain "${CXX:-c++}" -O3 -DNMR_MULTIVERSION=ON
    for level in best v3 base; do
        NMR_CPU_LEVEL=$level build/native/plain/workload 2 >"build/native/plain/$level.txt"
        cmp build/native/plain/best.txt "build/native/plain/$level.txt"
    done
}

check_asan() { UBSAN_OPTIONS=print_stacktrace=1 build_and_run asan "${CXX:-c++}" "$address"; }
check_tsan() { build_and_run tsan g++ "$sanitize -fsanitize=thread" -DNMR_OWN_GOMP=ON; }

check_fuzz() {
    want clang++
    build fuzz clang++ "$address -O2 -fsanitize-coverage=inline-8bit-counters,pc-table" fuzz -DNMR_FUZZER=ON
    "$python" tests/csrc/corpus.py unpack build/native/corpus
    nice -n 19 build/native/fuzz/fuzz -max_total_time="$1" -max_len=512 -entropic=0 -print_final_stats=1 -timeout=10 -rss_limit_mb=2048 \
        -artifact_prefix=build/native/fuzz/finding- build/native/corpus 2>&1 | tee build/native/fuzz.txt |
        grep -v -E "	(NEW|REDUCE|pulse) |NEW_FUNC"
}

check_keep() {
    rm -rf build/native/kept
    mkdir build/native/kept
    build/native/fuzz/fuzz -set_cover_merge=1 -use_counters=0 build/native/kept build/native/corpus 2>&1 | tail -1
    "$python" tests/csrc/corpus.py pack build/native/kept
}

count() { # instruction set, options of count.py
    want valgrind
    build "count-$1" "${CXX:-c++}" "-O3 -g -march=$1" workload
    "$python" tests/csrc/count.py "build/native/count-$1/workload" "$@"
}

check_count() { count x86-64-v3 "$@"; }
check_count-base() { count x86-64 "$@"; }

check_variants() { # on x86-64
    local variant name compiler flags run first=
    for variant in g++ "g++ -DNMR_MULTIVERSION" "g++ -march=x86-64-v3" "g++ -march=x86-64-v4" \
        clang++ "clang++ -march=x86-64-v3" "clang++ -march=x86-64-v4" aarch64-linux-gnu-g++; do
        read -r compiler flags <<<"$variant"
        name=${variant//[ =]/_} run=()
        [[ $compiler != aarch64* ]] || run=(qemu-aarch64 -L /usr/aarch64-linux-gnu)
        type "$compiler" "${run[@]:0:1}" >/dev/null 2>&1 || { echo "$variant: not installed, left out"; continue; }
        [[ $flags != *v4 ]] || grep -q avx512vl /proc/cpuinfo || { echo "$variant: no AVX-512 here, left out"; continue; }
        build "$name" "$compiler" "-O3 $flags" workload
        "${run[@]}" "build/native/$name/workload" 2 >"build/native/$name.txt"
        first=${first:-$name}
        diff "build/native/$first.txt" "build/native/$name.txt" || { echo "$variant: DIFFERENT"; exit 1; }
        echo "$variant: the same bits"
    done
}

check_coverage() {
    find build/native -name '*.gcda' -delete
    build_and_run coverage g++ "-O0 -g --coverage"
    "$python" -m gcovr --root . --filter csrc/ --exclude-throw-branches --exclude-unreachable-branches \
        --merge-mode-functions=separate build/native/coverage --txt --print-summary
}

mkdir -p build/native
check=check_${1:-none}
declare -F "$check" >/dev/null || { sed -n '2,4s/^# \{0,1\}//p' "$0"; exit 2; }
"$check" "${@:2}"
