#!/usr/bin/env bash
# Train CorrAdaptor and its ten rivals on the same pairs for the same minutes, and measure them side by side.
#
#   tools/rivals.sh train   [NAME…]   run pipelines/train_NAME.toml, one network after another, on one core
#   tools/rivals.sh measure [NAME…]   relative poses of pairs/val.h5 into results/rivals_pose.json
#
# Without names: all of them. pairs/ holds what `corrsfm train prepare` makes, see the recipes. A run that was
# stopped goes on where it was, and what is measured already is not measured again. The minutes are those of
# the processor, so that a network that ran beside other work had no less than the rest. results/rivals/ holds
# networks that were trained so.
set -euo pipefail

usage() { sed -n '2,10p' "$0" | sed 's/^# \{0,1\}//' >&2; exit 2; }
[ $# -ge 1 ] || usage
task=$1
shift
names=("$@")
[ $# -ge 1 ] || names=(corradaptor pointcn oanet lmcnet ms2dgnet clnet pgfnet convmatch ncmnet mgnet umatch)

case $task in
train)
  for name in "${names[@]}"; do
    corrsfm train run --config "pipelines/train_$name.toml" --threads 1 --resume
  done
  ;;
measure)
  methods=(--method ratio0.8+mutual/poselib --method ratio0.8+mutual/ransac)
  for name in "${names[@]}"; do
    # As trained here, or else as trained before.
    weights=runs/$name/latest.pt
    [ -e "$weights" ] || weights=results/rivals/$name.pt
    # The verdict of the papers, then the same LO-RANSAC for all, and OpenCV's RANSAC as the papers use it.
    for estimator in w8pt poselib ransac; do
      methods+=(--method "$name@pose:$weights/$estimator")
    done
  done
  corrsfm evaluate pose pairs/val.h5 "${methods[@]}" --results results/rivals_pose.json
  ;;
*) usage ;;
esac
