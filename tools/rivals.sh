#!/usr/bin/env bash
# Train CorrAdaptor and its ten rivals on the same pairs for the same minutes, and measure them side by side.
#
#   tools/rivals.sh train [NAME…]   run pipelines/train_NAME.toml into results/rivals/NAME.pt, one network after
#                                   another, on one core
#   tools/rivals.sh val   [NAME…]   relative poses of pairs/val.h5 into results/rivals_pose_val.json
#   tools/rivals.sh test  [NAME…]   the same of pairs/test.h5
#
# Without names: all of them. pairs/ holds what `corrsfm train prepare` makes, see the recipes. A run that was
# stopped goes on where it was, and what is measured already is not measured again. The minutes are those of
# the processor, so that a network that ran beside other work had no less than the rest. NAME_side is a network
# that reads side information, and mutual neighbours only.
set -euo pipefail

usage() { sed -n '2,12p' "$0" | sed 's/^# \{0,1\}//' >&2; exit 2; }
[ $# -ge 1 ] || usage
task=$1
shift
names=("$@")
[ $# -ge 1 ] || names=(corradaptor pointcn oanet lmcnet ms2dgnet clnet pgfnet convmatch ncmnet mgnet umatch)

case $task in
train)
  for name in "${names[@]}"; do
    corrsfm train run --config "pipelines/train_$name.toml" --threads 1 --resume
    cp "runs/$name/latest.pt" "results/rivals/$name.pt"
  done
  ;;
val | test)
  methods=(--method ratio0.8+mutual/poselib --method ratio0.8+mutual/ransac)
  for name in "${names[@]}"; do
    # The verdict of the papers, then the same LO-RANSAC for all, and OpenCV's RANSAC as the papers use it.
    for estimator in w8pt poselib ransac; do
      methods+=(--method "${name%%_*}@pose:results/rivals/$name.pt/$estimator")
    done
  done
  corrsfm evaluate pose "pairs/$task.h5" --max-per-scene 40 --threads 1 "${methods[@]}" \
    --baseline corradaptor@pose:results/rivals/corradaptor.pt/poselib \
    --results "results/rivals_pose_$task.json"
  ;;
*) usage ;;
esac
