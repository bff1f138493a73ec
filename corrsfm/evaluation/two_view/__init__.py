"""Methods on pairs of photos with known relative pose or homography."""
