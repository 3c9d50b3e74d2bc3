#!/usr/bin/env bash
# Trains the default weights again: bash configs/default/train.sh MAKEHUMAN_DATA, in the repository's root. What was interrupted goes
# on when it is run once more.
set -eu
for split in "train 932 800" "val 16 16"; do
  set -- "$1" $split
  cargo xtask prepare synth --split "$2" --subjects "$3" --seed 101 --config configs/data/default.toml -o people/default/synth
  cargo xtask prepare makehuman "$1" --split "$2" --subjects "$4" --seed 102 --config configs/data/default.toml -o people/default/makehuman
done
# Others, whose cameras stray less.
for split in "train 300" "val 24"; do
  set -- "$1" $split
  options="--config configs/data/small.toml --set views.arrangement=groups --set views.front_within_degrees=30"
  cargo xtask prepare synth --split "$2" --subjects "$3" --seed 1 $options -o people/small/synth
  cargo xtask prepare makehuman "$1" --split "$2" --subjects "$3" --seed 2 $options -o people/small/makehuman
done
# A few as large as photographs are.
for split in "train 45 40" "val 4 4"; do
  set -- "$1" $split
  options="--config configs/data/default.toml --set views.resolution=1024"
  cargo xtask prepare synth --split "$2" --subjects "$3" --seed 103 $options -o people/large/synth
  cargo xtask prepare makehuman "$1" --split "$2" --subjects "$4" --seed 104 $options -o people/large/makehuman
done
data="people/default/synth people/default/makehuman people/small/synth people/small/makehuman"
cargo xtask train-stage1 --config configs/default/stage1.toml --data $data --resume -o runs/default-points
cargo xtask train-stage2 --config configs/default/stage2.toml --data $data --weights runs/default-points/best.safetensors --resume -o runs/default-both
cargo xtask train-stage2 --config configs/default/regressor.toml --data people/large/synth people/large/makehuman \
  --weights runs/default-both/best.safetensors --resume -o runs/default
cargo xtask import-weights runs/default/best.safetensors --half -o default.safetensors
