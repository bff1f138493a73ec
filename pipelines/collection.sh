#!/usr/bin/env bash
# Reconstruct every scene of a collection: COLLECTION/<scene>/images → OUTPUT/<scene>.
# One scene's failure does not stop the others; run it again to go on where it stopped.
#
#   pipelines/collection.sh COLLECTION OUTPUT [options of corrsfm run …]
set -u
collection=${1:?folder with <scene>/images folders}
output=${2:?folder for the workspaces}
shift 2
failed=()
for images in "$collection"/*/images; do
    scene=$(basename "$(dirname "$images")")
    echo "== $scene"
    corrsfm run "$images" "$output/$scene" "$@" || failed+=("$scene")
done
echo "done; failed: ${#failed[@]} ${failed[*]-}"
[ ${#failed[@]} -eq 0 ]
