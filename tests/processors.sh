#!/bin/sh
# The numeric tests as other processors would run them: each line below limits the instruction sets of oneDNN,
# PyTorch, MKL, OpenBLAS and OpenCV, which then round and add in another order. Limits above what the machine
# has do nothing. `make test` is the run with all cores and every instruction.
#
#     make test-processors                      about two minutes of one core
#     sh tests/processors.sh PYTHON [TESTS...]  any tests, say: sh tests/processors.sh python tests/training
set -eu
python=${1:-python}
[ $# -gt 0 ] && shift
[ $# -gt 0 ] || set -- tests/model/test_network.py tests/prune/test_learned.py tests/matches \
    tests/pairs/test_retrieval.py tests/training/test_synthetic.py tests/training/test_losses.py

run() {
    limits=$1
    shift
    echo "== $limits"
    # shellcheck disable=SC2086  # words of the limits are separate settings
    env $limits "$python" -m pytest -q "$@"
}

run "OMP_NUM_THREADS=1 ONEDNN_MAX_CPU_ISA=AVX512_CORE" "$@"
run "OMP_NUM_THREADS=1 ONEDNN_MAX_CPU_ISA=AVX2 ATEN_CPU_CAPABILITY=avx2 MKL_ENABLE_INSTRUCTIONS=AVX2 OPENBLAS_CORETYPE=Haswell" "$@"
run "OMP_NUM_THREADS=1 ONEDNN_MAX_CPU_ISA=SSE41 ATEN_CPU_CAPABILITY=default MKL_CBWR=COMPATIBLE OPENBLAS_CORETYPE=Nehalem OPENCV_CPU_DISABLE=AVX2,AVX512-SKX" "$@"
