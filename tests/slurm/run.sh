#!/usr/bin/env bash
# Runs the scripts of docs/scale.md in a Slurm of one machine and two tasks: preparation array, training with a time limit and requeue, batch.
#   tests/slurm/run.sh PROGRAM      (as root; apt-get install slurmctld slurmd slurm-client munge openmpi-bin)
# PROGRAM is a snapsnap with the feature `mpi`. Everything lies in a temporary folder; Slurm is stopped at the end.
set -euo pipefail
program=$(realpath "$1")
here=$(dirname "$(realpath "$0")")
folder=$(mktemp -d)
host=$(hostname -s)
export SLURM_CONF=$folder/slurm.conf RAYON_NUM_THREADS=1
mkdir -p "$folder"/{state,spool,bin}
ln -s "$program" "$folder/bin/snapsnap"
export PATH=$folder/bin:$PATH

cat > "$SLURM_CONF" <<END
ClusterName=one
SlurmctldHost=$host(127.0.0.1)
SlurmUser=root
AuthType=auth/munge
MpiDefault=pmix
ProctrackType=proctrack/linuxproc
TaskPlugin=task/none
SelectType=select/cons_tres
SelectTypeParameters=CR_CPU
ReturnToService=2
SlurmctldPidFile=$folder/slurmctld.pid
SlurmdPidFile=$folder/slurmd.pid
StateSaveLocation=$folder/state
SlurmdSpoolDir=$folder/spool
SlurmctldLogFile=$folder/slurmctld.log
SlurmdLogFile=$folder/slurmd.log
JobRequeue=1
KillWait=10
NodeName=$host NodeAddr=127.0.0.1 CPUs=2 State=UNKNOWN
PartitionName=main Nodes=ALL Default=YES State=UP
END

stop() {
  scancel --user=root 2>/dev/null || true
  sleep 1
  kill "$(cat "$folder/slurmd.pid" 2>/dev/null)" "$(cat "$folder/slurmctld.pid" 2>/dev/null)" 2>/dev/null || true
  pkill -x munged || true
}
trap stop EXIT
mkdir -p /run/munge && chown munge:munge /run/munge
[ -s /etc/munge/munge.key ] || { dd if=/dev/urandom bs=1 count=1024 2>/dev/null > /etc/munge/munge.key; chown munge /etc/munge/munge.key; chmod 400 /etc/munge/munge.key; }
pgrep -x munged >/dev/null || runuser -u munge -- munged
slurmctld
slurmd
until sinfo -h -o %T 2>/dev/null | grep -q idle; do sleep 1; done
sinfo

# Waits for a job, whatever became of it.
finish() { while squeue -h -j "$1" 2>/dev/null | grep -q .; do sleep 1; done; }

cd "$folder"
cp "$here"/*.sbatch "$here/train.toml" .
echo "== preparation, an array of two"
job=$(sbatch --parsable prepare.sbatch); finish "$job"
cat prepare-*.log; ls people/train/img
echo "== training by two ranks, sent on by its time limit"
job=$(sbatch --parsable train.sbatch); finish "$job"
cat train.log
grep -c "interrupted after" train.log; grep "finished after" train.log
echo "== batch, an array of two"
mkdir pairs
for i in 0 1 2 3; do for side in front back; do cp "$here/../../assets/sample/$side.png" "pairs/${i}_$side.png"; done; done
job=$(sbatch --parsable batch.sbatch); finish "$job"
cat batch-*.log; ls made
