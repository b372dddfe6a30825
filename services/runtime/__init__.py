"""What every process needs: logs, signals, traces, certificates, problems.

These are all caches and variables that a process keeps from call to call;
``tests/services/runtime/test_process_state.py`` compares the list with the code.

================================================== ====== =============================================================
name                                               size   holds
================================================== ====== =============================================================
services.api.system.minified.minified_file         256    the files of the web app, as they are sent
services.cluster.connect._loop                     1      the event loop of dask clients, and its thread
services.cluster.task._objects                     1      a worker's open object store
services.runtime.tracing._tracer                   1      the tracer, if traces are asked for
storage.objects.event_loop._loop                   1      the event loop that reads and writes arrays, and its thread
storage.objects.zarr_store.array_metadata          1 each the zarr metadata of a dtype
workflows.composite.quantise._edges                1 each the codes of a transfer and a dtype: 0.4 MB or less
workflows.composite.strips._empty_strip            8      strips in which nothing is recovered, of a size each: 0.7 MB
workflows.images.hdr._codes                        1      the codes of sRGB for light: 0.1 MB
workflows.images.hdr.light_of_hdr                  2      the light of codes for HDR displays: 0.3 MB each
workflows.mattes.imports.reader._document_of_group 1      the zarr.json of a group
workflows.mattes.imports.reader._document_of_one   1 each the zarr.json of an array of a dtype
workflows.mattes.options._schemas                  2      the JSON schemas of a method's options
workflows.mattes.steps._cut_out                    1      where the object of the last matte recovered stands
workflows.mattes.tiles.gain_of                     1      the local tone mapping of the last capture recovered
workflows.mattes.tiles.mask_of                     1      the mask of the last capture recovered
workflows.mattes.tiles.patterns_of                 1      the patterns of the last capture recovered by lobes
workflows.mattes.tiles.program_of                  2      the program and the monitor curve of a capture
workflows.mattes.tiles.sensing_of                  1      the sensing matrices of the last capture recovered by NN-DGSR
workflows.threads._pool                            1      the threads of composites and previews
workflows.untrusted.decoder_process._signs         1      in a decoder, when it last gave a sign of life
================================================== ====== =============================================================

Besides, each `Objects` keeps the metadata of the 64 arrays it opened last, and the API and each task that composites a
clip keep strips of mattes within a number of bytes (`workflows.composite.cache.Cache`).
"""
