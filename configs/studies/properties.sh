#!/usr/bin/env bash
# Leave one property of the training people out (docs/notes/people.md): bash configs/studies/properties.sh MAKEHUMAN_DATA AVATARS, in the
# repository's root. It trains stage 1 on people of `makehuman` and `avatars` without the property, and judges it on held-out people of
# every maker with all properties. ROWS="all light" trains these rows only. An interrupted run continues when it is started again.
set -eu
makehuman=$1 avatars=$2
folder=people/properties runs=runs/properties
# people NAME SPLIT COUNT SEED OPTION…
people() {
  name=$1 split=$2 count=$3 seed=$4
  shift 4
  made() { cargo xtask prepare "$@" --split "$split" --subjects "$count" --seed "$seed" -o "$folder/$name/$1"; }
  made makehuman "$makehuman" "$@"
  # Avatars that cannot be read are skipped, with exit code 2.
  made avatars "$avatars" "$@" || [ $? = 2 ]
}
phone="--config configs/data/phone.toml"
# A training needs a training person, even for one step without effect.
for split in "val 40" "train 1"; do
  people held ${split% *} ${split#* } 43 $phone
  cargo xtask prepare synth --split "${split% *}" --subjects "${split#* }" --seed 43 $phone -o $folder/held/synth
done
train() {
  cargo xtask train-stage1 --config configs/studies/stage1.toml --resume "$@" --set samples.placed_share=1.0 --set training.preview_every=0
}
# row NAME OPTION…
row() {
  name=$1
  case " ${ROWS-$name} " in *" $name "*) ;; *) return 0 ;; esac
  people "$name" train 200 41 "${@:2}"
  train --data "$folder/$name/makehuman" "$folder/$name/avatars" --set training.steps=1000 --set training.validate_every=0 -o "$runs/$name"
  for maker in synth makehuman avatars; do
    # A step without effect, for its validation.
    train --data "$folder/held/$maker" --weights "$runs/$name/last.safetensors" --set training.steps=1 --set schedule.warm_up=0 \
      --set optimizer.rate=1e-12 --set optimizer.muon.rate=1e-12 --set training.validation_samples=160 -o "$runs/$name-on-$maker"
  done
}
row all $phone
row cameras --config configs/data/default.toml --set 'light.kind="random"'
row light $phone --set 'light.kind="even"'
