#!/usr/bin/env bash
# Trains networks like those of the default weights: bash configs/default/train.sh MAKEHUMAN_DATA AVATARS, in the repository's root. An
# interrupted training continues when it is started again. docs/weights.md says where the default weights' own training differed.
set -eu
makehuman=$1 avatars=$2 maker=
# The last generation of the first part. The second part has half as many.
last=${GENERATIONS:-16}
# An interrupted training writes its state and succeeds, so that the script has to end by itself.
trap 'exit 130' INT TERM
trap '[ -z "$maker" ] || kill -- "-$maker" 2> /dev/null || true' EXIT
further='--set light.kind="random" --set views.second_depth=true'
# people FOLDER SPLIT SEED SYNTH MAKEHUMAN AVATARS OPTION…: numbers of people of three makers.
people() {
  options="--split $2 --seed $3 ${*:7}"
  [ $4 = 0 ] || cargo xtask prepare synth $options --subjects $4 -o "people/$1/synth"
  cargo xtask prepare makehuman "$makehuman" $options --subjects $5 -o "people/$1/makehuman"
  # Avatars that cannot be read are skipped, with exit code 2.
  cargo xtask prepare avatars "$avatars" $options --subjects $6 -o "people/$1/avatars" || [ $? = 2 ]
}
# generation N: 600 people that no other generation has.
generation() {
  people "$1/phone" train $((9000 + $1)) 100 160 130 --config configs/data/phone.toml $further
  people "$1/default" train $((9000 + $1)) 50 90 70 --config configs/data/default.toml $further
}
data() { echo people/$1/{phone,default}/{synth,makehuman,avatars}; }
# points RUN CONFIG WEIGHTS FIRST LAST: stage 1 on these generations, 1,500 steps of 4 samples each: a person is used ten times. One
# thread makes the next generation meanwhile. Networks memorise people whom they see more often (docs/notes/weights.md).
points() {
  for ((n = $4; n <= $5; n++)); do
    [ ! -e "runs/$1.$n" ] || continue
    generation $n
    # In a process group of its own, which ends with the script.
    set -m
    [ $n = $5 ] || (renice -n 15 $BASHPID > /dev/null && RAYON_NUM_THREADS=1 generation $((n + 1))) &
    maker=$!
    set +m
    cargo xtask train-stage1 --config "configs/default/$2.toml" $3 --data $(data $n) $(data val) --resume --force \
      --set training.steps=$((1500 * (n - $4 + 1))) --set schedule.fall=$([ $n = $5 ] && echo 1500 || echo 0) -o "runs/$1"
    touch "runs/$1.$n"
    wait
    [ $n = $5 ] || rm -r "people/$n"
  done
}
for cameras in phone default; do
  people val/$cameras val 901 24 24 24 --config configs/data/$cameras.toml $further
done
# People in views of the size of photographs.
close="--config configs/data/phone.toml --set views.resolution=1024 --set views.count=4"
people close train 904 0 900 900 $close
people close val 904 0 16 16 $close
points default-photographs photographs "" 1 $last
# The network of the sides begins with random weights.
if [ ! -e runs/default-points ]; then
  network=(--config configs/studies/network.toml --set 'network.sides="completed"' --set network.second_layer=true)
  cargo xtask init-weights "${network[@]}" -o runs/default-random.safetensors
  cargo xtask import-weights runs/default-photographs/best.safetensors --fill runs/default-random.safetensors "${network[@]}" \
    -o runs/default-start.safetensors
fi
points default-points stage1 "--weights runs/default-start.safetensors" $((last + 1)) $((last + (last + 1) / 2))
cargo xtask train-stage2 --config configs/default/stage2.toml --data $(data $((last + (last + 1) / 2))) $(data val) \
  --weights runs/default-points/best.safetensors --resume -o runs/default-both
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
