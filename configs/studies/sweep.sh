#!/usr/bin/env bash
# Effect of each part of the default networks, and of their size (docs/notes/weights.md): bash configs/studies/sweep.sh MAKEHUMAN_DATA, in
# the repository's root. ROWS="base small" trains these rows only. An interrupted sweep continues when it is started again.
set -eu
makehuman=$1
# people FOLDER OPTION…: 100 training people and 16 held-out people of each kind.
people() {
  folder=people/sweep/$1
  shift
  for split in "train 100" "val 16"; do
    count=${split#* } split=${split% *}
    cargo xtask prepare synth --split "$split" --subjects "$count" --seed 1 --config configs/data/small.toml "$@" -o "$folder/synth"
    cargo xtask prepare makehuman "$makehuman" --split "$split" --subjects "$count" --seed 2 --config configs/data/small.toml "$@" -o "$folder/makehuman"
  done
}
people groups --set views.arrangement=groups --set views.front_within_degrees=30
people rings
cargo xtask prepare synth --split test --subjects 6 --seed 3 --config configs/data/evaluation.toml --set views.count=12 -o people/sweep/test
wanted() { case " ${ROWS-$1} " in *" $1 "*) ;; *) return 1 ;; esac; }
# row NAME DATA OPTION…: stage 1, and, for networks with another run time, one step of stage 2, which gives `bench` a regressor.
row() {
  name=$1 data="people/sweep/$2/synth people/sweep/$2/makehuman"
  wanted "$name" || return 0
  shift 2
  cargo xtask train-stage1 --config configs/studies/stage1.toml --data $data --set training.steps=400 --set training.ema_decay=0.99 \
    --set training.log_every=20 --set training.validate_every=100 --set training.validation_samples=32 "$@" --resume -o "runs/sweep/$name"
  case $name in no-* | plain | rings) return 0 ;; esac
  cargo xtask train-stage2 --config configs/studies/stage2.toml --data $data --weights "runs/sweep/$name/best.safetensors" \
    "$@" --set training.steps=1 --set schedule.warm_up=0 --set training.validation_samples=1 --resume -o "runs/sweep/$name/both"
}
row base groups
row no-mask groups --set network.mask_channel=false
row no-rays groups --set network.ray_channels=false
row no-mirror groups --set network.mirror=false
row no-anchor groups --set 'network.anchor="none"'
row no-place groups --set samples.placed_share=0.0
row plain groups --set network.mask_channel=false --set network.ray_channels=false --set network.mirror=false --set 'network.anchor="none"'
transformer="--set network.body=\"transformer\" --set network.enc_depth=4 --set network.dec_dim=128 --set network.dec_depth=3 \
  --set network.layer_dims=[16,32,48,64] --set network.feature_dim=32 --set network.last_dim=16 --set network.hooks=[0,1,2,3] --set network.patch=16"
row transformer groups $transformer
row rings rings
row whole-canvas groups --set network.window=false
row net-64 groups --set network.net_resolution=64
# A step takes four times as long.
row net-256 groups --set network.net_resolution=256 --set training.steps=100 --set training.validate_every=25
row small groups --set 'network.layer_dims=[16,32,48,64]' --set network.enc_dim=64 --set network.dec_dim=64 --set network.last_dim=16
row shallow groups --set network.enc_depth=3 --set network.dec_depth=2
row large groups --set 'network.layer_dims=[48,96,144,192]' --set network.enc_dim=192 --set network.dec_dim=192 --set network.last_dim=48
# regressor NAME OPTION…: stage 2 on the points of the row `base`.
regressor() {
  name=$1
  wanted "$name" || return 0
  shift
  cargo xtask train-stage2 --config configs/studies/stage2.toml --data people/sweep/groups/synth people/sweep/groups/makehuman \
    --weights runs/sweep/base/best.safetensors --set training.steps=150 --set training.validate_every=75 \
    --set training.validation_samples=16 "$@" --resume -o "runs/sweep/$name"
}
regressor regressor
regressor free-start --set 'regressor.start="published"'
if wanted bench; then
  cargo xtask bench --config configs/studies/sweep.toml -o reports/sweep
fi
