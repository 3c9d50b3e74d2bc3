#!/usr/bin/env bash
# Trains the default weights: bash configs/default/train.sh MAKEHUMAN_DATA, in the repository's root. An interrupted training continues
# when it is started again.
set -eu
makehuman=$1
# people FOLDER SPLIT SEED SYNTHETIC MAKEHUMAN OPTION…
people() {
  folder=people/$1 split=$2 seed=$3 synthetic=$4 made=$5
  shift 5
  cargo xtask prepare synth --split "$split" --subjects "$synthetic" --seed "$seed" "$@" -o "$folder/synth"
  cargo xtask prepare makehuman "$makehuman" --split "$split" --subjects "$made" --seed "$((seed + 1))" "$@" -o "$folder/makehuman"
}
own="--config configs/data/default.toml"
people default train 101 967 910 $own
people default val 101 16 16 $own
# Other people, with smaller deviations of the cameras.
less="--config configs/data/small.toml --set views.arrangement=groups --set views.front_within_degrees=30"
people small train 1 300 300 $less
people small val 1 24 24 $less
# A few people in views of the size of photographs.
people large train 103 45 40 $own --set views.resolution=1024
people large val 103 4 4 $own --set views.resolution=1024
data="people/default/synth people/default/makehuman people/small/synth people/small/makehuman"
cargo xtask train-stage1 --config configs/default/stage1.toml --data $data --resume -o runs/default-points
# Stage 1 once more, with a high initial rate.
cargo xtask train-stage1 --config configs/default/stage1.toml --data $data --weights runs/default-points/best.safetensors \
  --set training.steps=12_000 --set optimizer.rate=6e-4 --set optimizer.muon.rate=9e-4 --resume -o runs/default-again
cargo xtask train-stage2 --config configs/default/stage2.toml --data $data --weights runs/default-again/best.safetensors --resume -o runs/default-both
cargo xtask train-stage2 --config configs/default/regressor.toml --data people/large/synth people/large/makehuman \
  --weights runs/default-both/best.safetensors --resume -o runs/default
cargo xtask import-weights runs/default/best.safetensors --half -o default.safetensors
