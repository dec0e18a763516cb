#!/usr/bin/env bash
# Ten minutes on a GPU: what a step costs at the paper's size, then every stage of a run at that size.
#
#   bash examples/gpu.sh            on a GPU
#   bash examples/gpu.sh --quick    the same commands at the size debug, on a CPU, to try the script
#
# The folder OUT (gpu-check) gets bench.jsonl, bench.err and the run folder.
set -euo pipefail
OUT=${OUT:-gpu-check}
mkdir -p "$OUT"
if [ "${1:-}" = --quick ]; then
    QUICK=(--quick) PRESET=debug DEVICE=cpu
    SMALLER=()
else
    QUICK=() PRESET=paper DEVICE=cuda
    # So little of everything that all stages fit into minutes. It learns nothing.
    SMALLER=(--set collect.episodes=2 --set pretrain.steps=50 --set num_retrieve=2 --set bc_steps=100
        --set learning_starts=500 --set warmup_steps=500 --set train_ratio=64 --set evaluate.episodes=2)
fi
nvidia-smi --query-gpu=name,memory.total,driver_version --format=csv || true
zoo() { timeout 240 python -m wpt_agents.zoo "$@"; }
zoo bench gpu --precision bf16 --json "${QUICK[@]}" | tee "$OUT/bench.jsonl"
zoo bench gpu --precision bf16 --json --compile "${QUICK[@]}" 2> "$OUT/bench.err" | tee -a "$OUT/bench.jsonl" ||
    echo "torch.compile did not finish within 240 s or failed, see $OUT/bench.err"
zoo run --suite dmc --tasks walker-run --method wpt --preset "$PRESET" --frames 3000 \
    --device "$DEVICE" --set precision=bf16 "${SMALLER[@]}" --out "$OUT/runs"
