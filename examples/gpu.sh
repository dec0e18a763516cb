#!/usr/bin/env bash
# Measure a step at the paper's size on a GPU, then execute every stage of a run (ten minutes).
#
#   bash examples/gpu.sh            on a GPU
#   bash examples/gpu.sh --quick    test the script with the size debug on a CPU
#
# The folder OUT (gpu-check) gets bench.jsonl, bench.err and the run folder.
set -euo pipefail
OUT=${OUT:-gpu-check}
mkdir -p "$OUT"
if [ "${1:-}" = --quick ]; then
    QUICK=(--quick) PRESET=debug DEVICE=cpu
    SMALLER=() LIMITS=(600 180 600)
else
    QUICK=() PRESET=paper DEVICE=cuda
    LIMITS=(160 180 260)  # seconds, ten minutes in all
    # All stages finish within minutes with these settings, which are too small to learn anything.
    SMALLER=(--set collect.episodes=2 --set pretrain.steps=50 --set num_retrieve=2 --set bc_steps=100
        --set learning_starts=500 --set warmup_steps=500 --set train_ratio=64 --set evaluate.episodes=2)
fi
nvidia-smi --query-gpu=name,memory.total,driver_version --format=csv || true
zoo() { timeout "$1" python -m wpt_agents.zoo "${@:2}"; }  # the first argument is a limit in seconds
zoo "${LIMITS[0]}" bench gpu --precision bf16 --json "${QUICK[@]}" | tee "$OUT/bench.jsonl"
zoo "${LIMITS[1]}" bench gpu --precision bf16 --json --compile "${QUICK[@]}" 2> "$OUT/bench.err" | tee -a "$OUT/bench.jsonl" ||
    echo "torch.compile did not finish within ${LIMITS[1]} s or failed, see $OUT/bench.err"
zoo "${LIMITS[2]}" run --suite dmc --tasks walker-run --method wpt --preset "$PRESET" --frames 3000 \
    --device "$DEVICE" --set precision=bf16 "${SMALLER[@]}" --out "$OUT/runs"
