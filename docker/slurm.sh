#!/bin/bash
# Workers of a cluster on SLURM: an array of N jobs, by default of four cores each:
#
#   export ENVMATTE_CLUSTER=tls://HOST:8786 ENVMATTE_CERTS=/SHARED/certs   # and AWS_…, if the store is a bucket
#   sbatch --array=1-N slurm.sh
#
# `envmatte` must be in PATH. Run the scheduler and the services outside of SLURM, on machines that the nodes reach.
# A job that reaches its time limit is requeued, until `scancel`. Options of sbatch override the #SBATCH lines.

#SBATCH --job-name=envmatte
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=4
#SBATCH --mem-per-cpu=2G
#SBATCH --time=12:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
# Sent to this shell only, a minute before the time limit:
#SBATCH --signal=B:USR1@60

: "${ENVMATTE_CLUSTER:?name the scheduler, tls://HOST:PORT}" "${ENVMATTE_CERTS:?name the folder of certificates}"
export ENVMATTE_WORKERS=$SLURM_CPUS_ON_NODE
# SLURM counts in MiB. Taken as MB, the number leaves 5 % for the process that monitors the workers.
memory=${SLURM_MEM_PER_NODE:-$((SLURM_MEM_PER_CPU * SLURM_CPUS_ON_NODE))}
export ENVMATTE_WORKER_MEMORY=$((memory * 1000000 / SLURM_CPUS_ON_NODE))

envmatte worker &
worker=$! asked='' again=''
trap 'asked=1; kill $worker' TERM          # scancel, or preemption
trap 'asked=1 again=1; kill $worker' USR1  # the time limit
wait $worker
code=$?
if [ "$asked" ]; then  # a signal ends `wait` but not the worker
  wait $worker
  code=$?
fi
if [ "$again" ]; then
  exec scontrol requeue "$SLURM_JOB_ID"
fi
exit $code
