#!/usr/bin/env bash
# Run a study on all NVIDIA GPUs of a machine, with JOBS processes (default 5) on each that share it through MPS:
#     JOBS=5 bash studies/all_gpus.sh --config studies/few/study.py --results studies/few/results.json
# All processes share the study's folder, so that the same command continues what was interrupted.
set -eu
gpus=$(nvidia-smi --query-gpu=index --format=csv,noheader)
work=$(mktemp -d) pids=() code=0
stop() {
  [ ${#pids[@]} = 0 ] || kill "${pids[@]}" 2>/dev/null || true
  wait
  for pipe in "$work"/*/; do echo quit | CUDA_MPS_PIPE_DIRECTORY=$pipe nvidia-cuda-mps-control || true; done
  rm -rf "$work"
}
trap stop EXIT
trap 'exit 130' INT TERM
for gpu in $gpus; do
  # A daemon per GPU: a client that aborts takes the others of its daemon along.
  export CUDA_MPS_PIPE_DIRECTORY=$work/$gpu CUDA_MPS_LOG_DIRECTORY=$work/$gpu
  mkdir "$work/$gpu"
  CUDA_VISIBLE_DEVICES=$gpu nvidia-cuda-mps-control -d
  # Clients number the devices that their daemon shows.
  CUDA_VISIBLE_DEVICES=0 python -m lorasp_jax.extras.study "$@" --jobs "${JOBS:-5}" &
  pids+=($!)
done
for pid in "${pids[@]}"; do wait "$pid" || code=$?; done
pids=()
exit $code
