# sh tests/consumers.sh PYTHON FOLDER
#
# The packages that read our exports, nerfstudio's dataparser among them, beside those of PYTHON in a new
# environment FOLDER, and the tests that use them. Their requirements exclude each other and ours, so they come
# without; what they import is named here.
set -eu
python=$1 folder=$2
[ -x "$folder/bin/python" ] || "$python" -m venv "$folder"
site=$("$folder/bin/python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')
"$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))' > "$site/ours.pth"
install() { "$folder/bin/python" -m pip install --quiet --disable-pip-version-check "$@"; }
install --no-deps nerfstudio==1.1.5 jaxtyping viser msgspec websockets zstandard rich
install --no-deps gaussian-splatting==2.11.0 plyfile==1.1.5 tifffile
install --no-deps trimesh==5.2.0 pyntcloud==0.3.1 open3d==0.20.0 addict configargparse
install pandas scipy dash nbformat pydantic
install --no-deps --target "$folder/colmap3" --upgrade pycolmap==0.6.1
# The others' pytest plugins are not ours.
PYTEST_DISABLE_PLUGIN_AUTOLOAD=1 CORRSFM_OLD_PYCOLMAP="$folder/colmap3" \
    "$folder/bin/python" -m pytest -q -rs tests/export/test_consumers.py
