#!/usr/bin/env bash
# Checks the kernels (csrc/) without Python, in separate builds under build/native. Usage: bash tools/check_native.sh CHECK [ARGUMENTS]
#   tests         the C++ tests, and the fuzz target on its stored inputs
#   asan          the same under AddressSanitizer and UndefinedBehaviorSanitizer (CXX: g++ or clang++)
#   tsan          the same under ThreadSanitizer, with a small OpenMP replacement that it understands (g++)
#   tsan-clang    the same with LLVM's OpenMP, which reports its synchronisation to the sanitizer (clang++)
#   mutate SECONDS [SEED]  mutations of the fuzz target's inputs, the most executions per second; after a crash the input is in
#                 build/native/mutate/current-SEED
#   fuzz SECONDS  libFuzzer (clang++), which looks for new code; findings: build/native/fuzz/finding-*; inputs: build/native/corpus
#   keep          adds to tests/csrc/corpus.hex the inputs that reach new code
#   count         instructions of the kernels under callgrind, compared with tests/csrc/instructions.json; --store: new bounds
#   count-base, count-arm64   the same without AVX, and for arm64 under qemu
#   variants      whether every available compiler and instruction set gives the same bits
#   coverage      coverage of csrc/ and nmr/ by the C++ and Python tests (lines and branches)
# Exit status 77: a tool that the check needs is missing; a message names it. PYTHON: an interpreter that has cmeel-eigen
# (for coverage also the test extra); default .venv/bin/python.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

python=${PYTHON:-$PWD/.venv/bin/python}
PATH=$(dirname "$python"):$PATH # cmake and ninja of the test extra
export OMP_WAIT_POLICY=passive # there may be more threads than cores: do not spin
sanitize="-O1 -g -fno-omit-frame-pointer -fno-sanitize-recover=all -DNMR_FRESH_SCRATCH"
address="$sanitize -fsanitize=address,undefined,float-cast-overflow -D_GLIBCXX_ASSERTIONS"

skip() {
    printf 'skipped: %s\n' "$*"
    exit 77
}

want() { # program, which check needs it
    command -v "$1" >/dev/null || skip "$2 needs $1, which is not installed"
}

build() { # name, compiler, flags, targets, further cmake arguments
    local name=$1 compiler=$2 flags=$3 targets=$4
    shift 4
    local generator=()
    command -v ninja >/dev/null && generator=(-G Ninja)
    # shellcheck disable=SC2086
    cmake -S tests/csrc -B "build/native/$name" "${generator[@]}" -DCMAKE_CXX_COMPILER="$compiler" -DCMAKE_CXX_FLAGS="$flags" \
        -DCMAKE_BUILD_TYPE=None -DPython_EXECUTABLE="$python" "$@" >"build/native/$name.log" 2>&1 &&
        cmake --build "build/native/$name" --parallel "${JOBS:-2}" --target $targets >>"build/native/$name.log" 2>&1 ||
        { grep -E -A8 "error|Error|FAILED" "build/native/$name.log" | head -60; echo "the whole log: build/native/$name.log"; exit 1; }
}

run_tests() { # name of the build
    "build/native/$1/tests"
    "build/native/$1/fuzz" tests/csrc/corpus.hex
}

check_tests() {
    build plain "${CXX:-c++}" -O3 "tests fuzz" -DNMR_MULTIVERSION=ON # with the flags of the package
    run_tests plain
}

check_asan() {
    build asan "${CXX:-c++}" "$address" "tests fuzz"
    export UBSAN_OPTIONS=print_stacktrace=1
    run_tests asan
}

check_tsan() {
    want g++ "the ThreadSanitizer check"
    build tsan g++ "$sanitize -fsanitize=thread" "tests fuzz" -DNMR_OWN_GOMP=ON
    run_tests tsan
}

check_tsan_clang() {
    want clang++ "the ThreadSanitizer check with LLVM's OpenMP"
    build tsan-clang clang++ "$sanitize -fsanitize=thread" "tests fuzz"
    # The OpenMP library is not instrumented. Archer reports its synchronisation; without it the check is not possible.
    local archer
    archer=$(clang++ -print-resource-dir)/../../libarcher.so
    [ -f "$archer" ] || skip "LLVM's OpenMP has no libarcher.so"
    export TSAN_OPTIONS=ignore_noninstrumented_modules=1 OMP_TOOL_LIBRARIES=$archer ARCHER_OPTIONS=verbose=1
    run_tests tsan-clang
}

check_mutate() {
    build mutate "${CXX:-c++}" "$address -O2" fuzz -DNMR_MULTIVERSION=ON
    local inputs=build/native/mutate/inputs.hex seed=${2:-$RANDOM}
    [ ! -d build/native/corpus ] || "$python" tests/csrc/corpus.py list build/native/corpus >"$inputs"
    [ -s "$inputs" ] || cp tests/csrc/corpus.hex "$inputs"
    # Hardly any memory is waiting to be reused, and no stacks are kept for it: both cost more than the kernels.
    ASAN_OPTIONS=quarantine_size_mb=1:malloc_context_size=0:detect_leaks=0 nice -n 19 \
        build/native/mutate/fuzz -mutate "$1" "$seed" "build/native/mutate/current-$seed" "$inputs"
}

check_fuzz() {
    want clang++ libFuzzer
    build fuzz clang++ "$address -O2 -fsanitize-coverage=inline-8bit-counters,pc-table" fuzz -DNMR_FUZZER=ON
    "$python" tests/csrc/corpus.py unpack build/native/corpus
    nice -n 19 build/native/fuzz/fuzz -max_total_time="$1" -max_len=512 -entropic=0 -print_final_stats=1 -timeout=10 -rss_limit_mb=2048 \
        -artifact_prefix=build/native/fuzz/finding- build/native/corpus 2>&1 | tee build/native/fuzz.txt |
        grep -v -E "	(NEW|REDUCE|pulse) |NEW_FUNC"
}

check_keep() {
    [ -x build/native/fuzz/fuzz ] || skip "there is no fuzz build yet; run check_native.sh fuzz SECONDS first"
    rm -rf build/native/kept
    mkdir build/native/kept
    build/native/fuzz/fuzz -set_cover_merge=1 -use_counters=0 build/native/kept build/native/corpus 2>&1 | tail -1
    "$python" tests/csrc/corpus.py pack build/native/kept
}

check_count() {
    want valgrind "the instruction count"
    [ "$(uname -m)" = x86_64 ] || skip "the stored bound is for x86-64-v3"
    build count "${CXX:-c++}" "-O3 -g -march=x86-64-v3" workload
    "$python" tests/csrc/count.py build/native/count/workload "${CXX:-c++}" "$@"
}

check_count_base() {
    want valgrind "the instruction count"
    [ "$(uname -m)" = x86_64 ] || skip "the stored bound is for x86-64"
    build count-base "${CXX:-c++}" "-O3 -g" workload
    "$python" tests/csrc/count.py build/native/count-base/workload "${CXX:-c++}" --target x86-64 "$@"
}

check_count_arm64() {
    want aarch64-linux-gnu-g++ "the instruction count for arm64"
    want qemu-aarch64 "the instruction count for arm64"
    build arm64 aarch64-linux-gnu-g++ -O3 workload -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64
    "$python" tests/csrc/count.py build/native/arm64/workload aarch64-linux-gnu-g++ --target arm64 "$@"
}

check_variants() {
    local name compiler flags results=build/native/variants.txt
    rm -f "$results"
    while read -r name compiler flags; do
        command -v "$compiler" >/dev/null || { echo "$name: no $compiler, left out"; continue; }
        if [ "$name" = arm64 ]; then
            command -v qemu-aarch64 >/dev/null || { echo "$name: no qemu-aarch64, left out"; continue; }
            build "$name" "$compiler" "-O3${flags:+ $flags}" workload -DCMAKE_SYSTEM_NAME=Linux -DCMAKE_SYSTEM_PROCESSOR=aarch64
            qemu-aarch64 -L /usr/aarch64-linux-gnu "build/native/$name/workload" 2 >"build/native/$name.txt"
        else
            case $(uname -m)/$flags in x86_64/* | */ | */-D*) ;; *) continue ;; esac
            case $flags in *v4*) grep -q avx512vl /proc/cpuinfo || { echo "$name: no AVX-512 here, left out"; continue; } ;; esac
            local multi=OFF
            [ "$name" != dispatch ] || multi=ON
            build "$name" "$compiler" "-O3 $flags" workload -DNMR_MULTIVERSION=$multi
            "build/native/$name/workload" 2 >"build/native/$name.txt"
        fi
        [ -f "$results" ] || { cp "build/native/$name.txt" "$results"; cat "$results"; }
        diff "$results" "build/native/$name.txt" && echo "$name: the same bits" || echo "$name: DIFFERENT" | tee -a build/native/different
    done <<'VARIANTS'
baseline g++
loops g++ -DNMR_NO_VECTOR_TYPES
dispatch g++
avx2 g++ -march=x86-64-v3
avx512 g++ -march=x86-64-v4
clang clang++
clang-avx2 clang++ -march=x86-64-v3
clang-avx512 clang++ -march=x86-64-v4
arm64 aarch64-linux-gnu-g++
VARIANTS
    [ ! -f build/native/different ] || { rm build/native/different; exit 1; }
}

check_coverage() {
    "$python" -c 'import gcovr' 2>/dev/null || skip "no gcovr in $python (it comes with the test extra)"
    build coverage g++ "-O0 -g --coverage" "tests fuzz"
    find build/native/coverage -name '*.gcda' -delete
    run_tests coverage
    # A copy of the package, so that the Python tests run with the instrumented kernels and bindings.
    local package=build/native/coverage-package
    mkdir -p $package
    rm -rf $package/nmr
    cp -r nmr $package/nmr
    rm -f $package/nmr/_C*
    cmake -S . -B $package/build -DCMAKE_BUILD_TYPE=None -DCMAKE_CXX_FLAGS="-O0 -g --coverage" -DNMR_MULTIVERSION=OFF \
        -DPython_EXECUTABLE="$python" -Dpybind11_DIR="$("$python" -m pybind11 --cmakedir)" -DCMAKE_LIBRARY_OUTPUT_DIRECTORY="$PWD/$package/nmr" \
        >build/native/coverage-package.log 2>&1 &&
        cmake --build $package/build --parallel "${JOBS:-2}" >>build/native/coverage-package.log 2>&1 ||
        { cat build/native/coverage-package.log; exit 1; }
    find $package/build -name '*.gcda' -delete
    # Run pytest in that folder, so that it imports this package. Tests that start an isolated interpreter would not, and are left out.
    local root=$PWD
    export COVERAGE_FILE=$root/build/native/coverage-python
    (cd $package && "$python" -m pytest -q --rootdir="$root" -c "$root/pyproject.toml" "$root/tests/nmr" --cov=nmr --cov-branch \
        --cov-report= -k "not one_openmp_runtime and not running_out_of_memory" "$@")
    "$python" -m coverage report --skip-covered --include="*/nmr/*"
    local gcovr=("$python" -m gcovr --root . --filter csrc/ --exclude-throw-branches --exclude-unreachable-branches
        --merge-mode-functions=separate build/native/coverage $package/build)
    "${gcovr[@]}" --json build/native/coverage.json
    gcovr=("$python" -m gcovr --root . --merge-lines --add-tracefile build/native/coverage.json)
    "${gcovr[@]}" --txt
    "${gcovr[@]}" --txt-metric branch --txt
    "${gcovr[@]}" --txt /dev/null --print-summary
}

[ $# -gt 0 ] || { sed -n '2,18s/^# \{0,1\}//p' "$0"; exit 2; }
mkdir -p build/native
check=$1
shift
case $check in
tests | asan | tsan | tsan-clang | variants | coverage | keep)
    [ $# -eq 0 ] || { echo "$check takes no arguments, got: $*"; exit 2; } ;;
esac
case $check in
tests | asan | tsan | count | variants | coverage | mutate | fuzz | keep) "check_$check" "$@" ;;
tsan-clang) check_tsan_clang ;;
count-base) check_count_base "$@" ;;
count-arm64) check_count_arm64 "$@" ;;
*) echo "unknown check: $check"; exit 2 ;;
esac
