#!/bin/sh
# Take a picture of a recording in the Rerun viewer, without a display.
#   deploy/screenshot.sh native RUN.rrd OUT.png     the window, under Xvfb with software Vulkan
#   deploy/screenshot.sh web RUN.rrd OUT.png        the web page, in headless Chromium
#   deploy/screenshot.sh window PORT OUT.png        the window of a running `semcast ... --view native`
#   deploy/screenshot.sh page URL OUT.png           the page of a running `semcast ... --view web`
# Debian or Ubuntu: apt-get install xvfb mesa-vulkan-drivers chromium
# Environment: SIZE=1600x960, RERUN=rerun, PYTHON=python3, CHROMIUM=chromium, WAIT_S=25 (seconds until the picture).
set -eu

if [ $# -ne 3 ]; then
  sed -n '2,8s/^# \{0,1\}//p' "$0" >&2
  exit 2
fi
mode=$1 run=$2 out=$3
size=${SIZE:-1600x960}
rerun=${RERUN:-$([ -x .venv/bin/rerun ] && echo .venv/bin/rerun || echo rerun)}
python=${PYTHON:-$([ -x .venv/bin/python ] && echo .venv/bin/python || echo python3)}
wait_s=${WAIT_S:-25}
scratch=$(mktemp -d)
viewer=
cleanup() {
  # The viewer runs in a group of its own: ending the wrapper alone would leave it behind.
  [ -z "$viewer" ] || kill -- "-$viewer" 2>/dev/null || true
  rm -rf "$scratch"
}
trap cleanup EXIT INT TERM
# Opened here: the viewer starts beside this script, and may come to its log only when that is cleaned up.
exec 3>"$scratch/rerun.log"

free_port() {
  "$python" -c 'import socket; s = socket.socket(); s.bind(("127.0.0.1", 0)); print(s.getsockname()[1])'
}

photograph_page() {
  "$python" "$(dirname "$0")/photograph_page.py" "$1" "$out" "$size" "$wait_s"
}

photograph_window() {
  "$python" - "$1" "$(realpath -m "$out")" <<'END'
import sys
from rerun.experimental import ViewerClient
ViewerClient.connect(f"rerun+http://127.0.0.1:{sys.argv[1]}/proxy").save_screenshot(sys.argv[2])
END
}

case $mode in
native)
  icd=$(ls /usr/share/vulkan/icd.d/lvp_icd*.json 2>/dev/null | head -n 1)
  [ -n "$icd" ] || { echo "no software Vulkan found: apt-get install mesa-vulkan-drivers" >&2; exit 1; }
  port=$(free_port)
  # A screen larger than the window keeps the pointer, which starts in its middle, off the picture.
  VK_ICD_FILENAMES=$icd XDG_RUNTIME_DIR=$scratch WINIT_X11_SCALE_FACTOR=1 \
    setsid xvfb-run -a -s "-screen 0 4096x2400x24" \
    "$rerun" --bind 127.0.0.1 --port "$port" "$run" --window-size "$size" >&3 2>&3 &
  viewer=$!
  sleep "$wait_s"
  photograph_window "$port" || { tail -5 "$scratch/rerun.log" >&2; exit 1; }
  ;;
web)
  port=$(free_port) web_port=$(free_port)
  setsid "$rerun" --bind 127.0.0.1 --port "$port" --serve-web --web-viewer-port "$web_port" "$run" \
    >&3 2>&3 &
  viewer=$!
  i=0
  until "$python" -c "import socket; socket.create_connection(('127.0.0.1', $web_port), 1)" 2>/dev/null; do
    i=$((i + 1))
    [ $i -lt 100 ] || { tail -5 "$scratch/rerun.log" >&2; exit 1; }
    sleep 0.1
  done
  photograph_page "http://127.0.0.1:$web_port/?url=rerun%2Bhttp://127.0.0.1:$port/proxy&renderer=webgl"
  ;;
window)
  photograph_window "$run"
  ;;
page)
  photograph_page "$run&renderer=webgl"
  ;;
*)
  echo "the mode must be native, web, window or page, got '$mode'" >&2
  exit 2
  ;;
esac
[ -s "$out" ] || { echo "no picture was taken" >&2; exit 1; }
echo "$out"
