#!/usr/bin/env bash
# Train the small OANet once as a base and once for each change of its recipe or of what it learns from, from
# nothing, in 15 minutes of one processor core each, and measure them side by side on validation pairs.
#
#   tools/ablations.sh train   NAME → runs/ablation/NAME/latest.pt
#   tools/ablations.sh val     → results/ablation_4096.json and results/ablation_2000.json, by keypoints a photo
#   tools/ablations.sh data    → results/ablation_data_KIND.json, by keypoints a photo or extractor
#
# pairs/ holds train_negatives.h5 (4,096 keypoints a photo), val.h5 (2,000) and val_4096.h5, which
# `corrsfm train prepare` makes, see pipelines/train_oanet_more.toml; for the data also train_2000.h5 and
# val_1000.h5 and val_8192.h5, made likewise with --max-features, and train_pycolmap.h5 (half as many pairs a
# scene) and val_pycolmap.h5 with --extractor pycolmap. A run that was stopped goes on where it was.
set -euo pipefail

names=(base negatives threshold thinning wide)
data=(counts extractors)

recipe() { # the recipe of a name
  local negative_share=0.0 threshold=1e-4 thin_probability=0.3 channels=32 clusters=48 more=""
  case $1 in
  negatives) negative_share=0.15 ;; # pairs of two places
  threshold) threshold=3e-5 ;;      # stricter labels
  thinning) thin_probability=0.6 ;; # of the pairs lose right matches
  wide) channels=64 clusters=64 ;;
  counts) more=', "pairs/train_2000.h5"' ;;         # 2,000 keypoints a photo, too
  extractors) more=', "pairs/train_pycolmap.h5"' ;; # COLMAP's SIFT, too
  esac
  cat <<TOML
[train]
train_files = ["pairs/train_negatives.h5"$more]
val_file = "pairs/val.h5"
output = "runs/ablation/$1"
input = "mutual"
negative_share = $negative_share
batch_size = 8
num_matches = 512
max_minutes = 15
processor_time = true
learning_rate = 1e-3
threshold = $threshold

[augment]
thin_probability = $thin_probability

[network]
architecture = "oanet"
channels = $channels
clusters = $clusters
side_channels = 5
TOML
}

compare() { # what the results are called after ablation_, the names, and the kinds of pairs
  local prefix=$1 names=$2 methods=(--method ratio0.8+mutual/poselib) name kind pairs
  for name in $names; do methods+=(--method "oanet@pose:runs/ablation/$name/latest.pt/poselib"); done
  methods+=(--method oanet@pose/poselib --method corradaptor@pose/poselib)
  for kind in "${@:3}"; do
    pairs=pairs/val_$kind.h5
    [ "$kind" != 2000 ] || pairs=pairs/val.h5
    corrsfm evaluate pose "$pairs" --max-per-scene 40 --threads 1 "${methods[@]}" \
      --baseline oanet@pose:runs/ablation/base/latest.pt/poselib --results "results/ablation_$prefix$kind.json"
  done
}

case ${1:-} in
train)
  mkdir -p runs/ablation
  for name in "${names[@]}" "${data[@]}"; do
    recipe "$name" > "runs/ablation/$name.toml"
    corrsfm train run --config "runs/ablation/$name.toml" --threads 1 --resume
  done
  ;;
val) compare "" "${names[*]}" 4096 2000 ;;
data) compare data_ "base ${data[*]}" 1000 2000 4096 8192 pycolmap ;;
*)
  sed -n '2,13p' "$0" | sed 's/^# \{0,1\}//' >&2
  exit 2
  ;;
esac
