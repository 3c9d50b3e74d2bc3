#!/usr/bin/env bash
# Leave one maker out (docs/notes/people.md): bash configs/studies/makers.sh MAKEHUMAN_DATA AVATARS, in the repository's root. It trains
# stage 1 on people of all three makers, and without each of them, and judges each network on held-out people of every maker.
# ROWS="all no-synth" trains these rows only, STEPS=1000 makes them shorter. An interrupted run continues when it is started again.
set -eu
makehuman=$1 avatars=$2
folder=people/makers runs=runs/makers
# people KIND…: 400 training people and 40 held-out people.
people() {
  for split in "val 40" "train 400"; do
    # Avatars that cannot be read are skipped, with exit code 2.
    cargo xtask prepare "$@" --split "${split% *}" --subjects "${split#* }" --seed 301 --config configs/data/default.toml \
      --set 'light.kind="random"' --set views.second_depth=true -o "$folder/$1" || [ "$1" = avatars ]
  done
}
people synth
people makehuman "$makehuman"
people avatars "$avatars"
train() { cargo xtask train-stage1 --config configs/studies/stage1.toml --resume "$@" --set training.preview_every=0; }
# row NAME STEPS MAKER…: the training on these makers, and one step without effect on each maker for its validation. STEPS are those of a
# training of 2000.
row() {
  name=$1 steps=$(($2 * ${STEPS-2000} / 2000))
  shift 2
  case " ${ROWS-$name} " in *" $name "*) ;; *) return 0 ;; esac
  train --data "${@/#/$folder/}" --set training.steps="$steps" --set training.validate_every=1000 --set training.validation_samples=60 \
    ${options-} -o "$runs/$name"
  for maker in synth makehuman avatars; do
    train --data "$folder/$maker" --weights "$runs/$name/best.safetensors" ${options-} --set training.steps=1 --set schedule.warm_up=0 \
      --set optimizer.rate=1e-12 --set optimizer.muon.rate=1e-12 --set training.validation_samples=160 -o "$runs/$name-on-$maker"
  done
}
row all 2000 synth makehuman avatars
row no-synth 2000 makehuman avatars
row no-makehuman 2000 synth avatars
row no-avatars 2000 synth makehuman
# Completed sides, for the time of 2000 steps of the others.
options='--set network.sides="completed"'
row completed 1400 synth makehuman avatars
row completed-no-synth 1400 makehuman avatars
row completed-no-makehuman 1400 synth avatars
row completed-no-avatars 1400 synth makehuman
options='--set network.sides="completed" --set stage1.relief_weight=1'
row relief 1400 synth makehuman avatars
# Photographs alone.
options='--set network.side_heads=false'
row photographs 2000 synth makehuman avatars
row photographs-no-synth 2000 makehuman avatars
options='--set network.sides="completed" --set network.second_layer=true'
row second 1400 synth makehuman avatars
