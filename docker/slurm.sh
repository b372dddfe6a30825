#!/bin/bash
# Workers of a cluster on SLURM, as an array of N jobs, of four cores each if nothing else is said:
#
#   export ENVMATTE_CLUSTER=tls://HOST:8786 ENVMATTE_CERTS=/SHARED/certs   # and AWS_…, if the store is a bucket
#   sbatch --array=1-N slurm.sh
#
# `envmatte` has to be in PATH. The scheduler and the services run where they may stay, and where the nodes reach them.
# A job whose time is over queues up again, until `scancel`. What #SBATCH says, options of sbatch overrule.

#SBATCH --job-name=envmatte
#SBATCH --nodes=1
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=4
#SBATCH --mem-per-cpu=2G
#SBATCH --time=12:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
# A minute before the time is over, and to this shell alone:
#SBATCH --signal=B:USR1@60

: "${ENVMATTE_CLUSTER:?name the scheduler, tls://HOST:PORT}" "${ENVMATTE_CERTS:?name the folder of certificates}"
export ENVMATTE_WORKERS=$SLURM_CPUS_ON_NODE
# SLURM counts in MiB. As MB it leaves 5 % to the process that watches over the workers.
memory=${SLURM_MEM_PER_NODE:-$((SLURM_MEM_PER_CPU * SLURM_CPUS_ON_NODE))}
export ENVMATTE_WORKER_MEMORY=$((memory * 1000000 / SLURM_CPUS_ON_NODE))

envmatte worker &
worker=$! asked='' again=''
trap 'asked=1; kill $worker' TERM          # scancel, or a job that goes first
trap 'asked=1 again=1; kill $worker' USR1  # the time is over
wait $worker
code=$?
if [ "$asked" ]; then  # a signal ends `wait`, and not the worker
  wait $worker
  code=$?
fi
if [ "$again" ]; then
  exec scontrol requeue "$SLURM_JOB_ID"
fi
exit $code
