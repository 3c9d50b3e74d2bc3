#!/bin/sh
# Tests and measures snapsnap on this machine and writes report.md: sh run.sh [DEVICE [FOLDER]]
# DEVICE: @DEVICE@ (default), wgpu, vulkan, cpu, … as `bin/snapsnap reconstruct --help` has them. Needs no cargo.
cd "$(dirname "$0")" || exit 1
device=${1:-@DEVICE@}
out=${2:-report}
mkdir -p "$out" || exit 1
export SNAPSNAP_ROOT="$PWD" SNAPSNAP_PROGRAM="$PWD/bin/snapsnap" XDG_RUNTIME_DIR="${XDG_RUNTIME_DIR:-/tmp}"
report="$out/report.md"
failed=0
# The tests name the CPU by its backend, and devices without an index.
case $device in cpu) tested=flex ;; *) tested=${device%%:*} ;; esac

# part NAME FILE COMMAND…: runs the command, keeps its output in FILE, and reports its exit code and time.
part() {
  name=$1 log=$2
  shift 2
  start=$(date +%s)
  "$@" >"$out/$log" 2>&1
  code=$?
  [ $code -eq 0 ] || failed=1
  { echo; echo "## $name"; echo; echo "\`$*\`: exit code $code, $(($(date +%s) - start)) s; full output: $log"; echo; } >>"$report"
  echo "$name: exit code $code"
}

{
  echo "# snapsnap on $device"
  echo
  echo "Commit @COMMIT@, features: @FEATURES@; $(date -u '+%Y-%m-%d %H:%M') UTC, $(uname -sm), $(nproc 2>/dev/null) cores."
  command -v nvidia-smi >/dev/null && nvidia-smi --query-gpu=name,driver_version,memory.total --format=csv,noheader
} >"$report"

# Two runs: the first one on an adapter selects kernels by trial.
for run in 1 2; do
  part "Numerical tests, run $run" "numerical-$run.log" \
    env SNAPSNAP_TEST_DEVICE="$tested" SNAPSNAP_REQUIRE_WGPU=1 bin/numerical --show-output
  grep -E '^test result|FAILED|SKIPPED' "$out/numerical-$run.log" >>"$report"
done

part "Splatting" splat.log bin/splat --full --device "$device"
grep '^|' "$out/splat.log" >>"$report"

work=$(mktemp -d) || exit 1
trap 'rm -rf "$work"' EXIT
trap 'exit 130' INT TERM
part "A person to photograph" person.log \
  bin/snapsnap prepare synth --subjects 1 --set views.count=2 -o "$work/people"
part "Random weights of full size" weights.log \
  bin/snapsnap init-weights --config configs/full.toml -o "$work/weights.safetensors"
views="$work/people/train/img/0000"
for run in 1 2 3 4; do
  part "Reconstruction, run $run" "reconstruct-$run.log" \
    bin/snapsnap reconstruct "$views/0.png" "$views/1.png" --weights "$work/weights.safetensors" \
    --device "$device" -v -o "$work/human.ply" --turntable "$work/turn.png"
  sed 's/^/    /' "$out/reconstruct-$run.log" >>"$report"
done
cp "$work/turn.png" "$out/turntable.png" 2>/dev/null
echo "$report"
exit $failed
