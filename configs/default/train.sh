#!/usr/bin/env bash
# Trains networks like those of the default weights: bash configs/default/train.sh MAKEHUMAN_DATA AVATARS, in the repository's root. An
# interrupted training continues when it is started again. docs/weights.md says where the default weights' own training differed.
set -eu
makehuman=$1 avatars=$2
# bodies FOLDER SPLIT SEED COUNT OPTION…: people of two makers.
bodies() {
  options="--split $2 --seed $3 --subjects $4 ${*:5}"
  cargo xtask prepare makehuman "$makehuman" $options -o "people/$1/makehuman"
  # Avatars that cannot be read are skipped, with exit code 2.
  cargo xtask prepare avatars "$avatars" $options -o "people/$1/avatars" || [ $? = 2 ]
}
# people FOLDER SPLIT SEED COUNT OPTION…: people of all three makers.
people() {
  further='--set light.kind="random" --set views.second_depth=true'
  cargo xtask prepare synth --split $2 --seed $3 --subjects $4 ${*:5} $further -o "people/$1/synth"
  bodies "$@" $further
}
for cameras in default phone; do
  people $cameras train 901 500 --config configs/data/$cameras.toml
  people $cameras val 901 24 --config configs/data/$cameras.toml
done
# People in views of the size of photographs.
bodies close train 904 900 --config configs/data/phone.toml --set views.resolution=1024 --set views.count=4
bodies close val 904 16 --config configs/data/phone.toml --set views.resolution=1024 --set views.count=4
data="people/default/synth people/default/makehuman people/default/avatars people/phone/synth people/phone/makehuman people/phone/avatars"
cargo xtask train-stage1 --config configs/default/photographs.toml --data $data --resume -o runs/default-photographs
# The network of the sides begins with random weights.
if [ ! -e runs/default-points ]; then
  network=(--config configs/studies/network.toml --set 'network.sides="completed"' --set network.second_layer=true)
  cargo xtask init-weights "${network[@]}" -o runs/default-random.safetensors
  cargo xtask import-weights runs/default-photographs/best.safetensors --fill runs/default-random.safetensors "${network[@]}" \
    -o runs/default-start.safetensors
fi
cargo xtask train-stage1 --config configs/default/stage1.toml --data $data --weights runs/default-start.safetensors --resume \
  -o runs/default-points
cargo xtask train-stage2 --config configs/default/stage2.toml --data $data --weights runs/default-points/best.safetensors --resume \
  -o runs/default-both
# Details have random weights at first. The other layers stay as they are.
details="--set network.details.resolution=1024"
if [ ! -e runs/default-details ]; then
  photographs="--set network.side_heads=false --set network.second_layer=false $details"
  cargo xtask init-weights --config configs/studies/network.toml $photographs -o runs/details-random.safetensors
  cargo xtask import-weights runs/default-both/best.safetensors --fill runs/details-random.safetensors $photographs \
    -o runs/details-start.safetensors
fi
cargo xtask train-stage1 --config configs/default/details.toml --data people/close/makehuman people/close/avatars \
  --weights runs/details-start.safetensors --resume -o runs/default-details
[ -e runs/detailed.safetensors ] || cargo xtask import-weights runs/default-both/best.safetensors --fill runs/default-details/best.safetensors \
  $details -o runs/detailed.safetensors
cargo xtask train-stage2 --config configs/default/regressor.toml --data people/close/makehuman people/close/avatars \
  --weights runs/detailed.safetensors --resume -o runs/default
cargo xtask import-weights runs/default/best.safetensors --half -o default.safetensors
