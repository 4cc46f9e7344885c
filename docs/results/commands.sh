# The commands that made the files of this folder, each with the table of docs/results.md that it fills.
# Words in capitals are folders. Repeat `make-dataset` for each category.
# Without `precision` it is bf16 on processors that are fast with it, as for these files (with AMX); elsewhere add precision=bf16 to --set.

# On Debian with the components main, contrib and non-free; then, for each category:
python tools/free_meshes/fetch.py --output models

learn3d make-dataset --output DATA --category airplane --source models/airplane --front z --augment 6

# Table 1: VPL with one seed, then one report
learn3d experiment kato --data DATA --output OUTPUT --category airplane,chair,table --methods Vanilla-AE Proposed --iterations 2000 --seeds 3 --set clamp_to_cube=true
learn3d experiment kato --data DATA --output OUTPUT --category airplane,chair,table --methods VPL --iterations 2000 --seeds 1 --set clamp_to_cube=true vpl:lambda_discriminator=0.1
learn3d experiment kato --data DATA --output OUTPUT --category airplane,chair,table --iterations 2000 --seeds 3 --set clamp_to_cube=true vpl:lambda_discriminator=0.1 --report-only

# Table 1, longer
learn3d experiment kato --data DATA --output LONG --category airplane,chair,table --methods Vanilla-AE Proposed --iterations 5000 --seeds 1 --set clamp_to_cube=true validate_every=500

learn3d make-dataset --output CARS --category car --procedural 2000

# Generated cars
learn3d experiment kato --data CARS --output CARS_OUTPUT --category car --methods Vanilla-AE Proposed --iterations 5000 --seeds 1 --set clamp_to_cube=true validate_every=1000

# Generated cars, table 4
learn3d experiment ablation --data CARS --output CARS_OUTPUT --category car --methods Proposed "w/o adversarial" --iterations 5000 --seeds 1 --set clamp_to_cube=true validate_every=1000

learn3d make-dataset --output CARS100 --category car --procedural 100 --augment 6

# Generated airplanes (the first lines of tools/paper_runs.sh). For the shorter lengths give --iterations 1000 first, then
# 2000, 4000 and 10000, in the same folder, and keep kato.json after each
learn3d make-dataset --layout kato --output GENERATED --category airplane --procedural 2000
learn3d experiment kato --data GENERATED --output GENERATED_OUTPUT --category airplane --methods Vanilla-AE Proposed --iterations 20000 --seeds 1 --set clamp_to_cube=true validate_every=1000 precision=fp32

# Generated airplanes, table 4 (stopped early: ablation-generated.json has the validations out of metrics.jsonl)
learn3d experiment ablation --data GENERATED --output GENERATED_OUTPUT --category airplane --methods Proposed "w/o adversarial" "w/o prior" --iterations 20000 --seeds 1 --set clamp_to_cube=true validate_every=1000 precision=fp32

# Generated chairs; with --iterations 20000 afterwards the same runs go on (kato-generated-chairs-longer.json has the
# validations out of metrics.jsonl, up to 6,000 steps)
learn3d make-dataset --layout kato --output CHAIRS --category chair --procedural 2000
learn3d experiment kato --data CHAIRS --output CHAIRS_OUTPUT --category chair --methods Vanilla-AE Proposed --iterations 3000 --seeds 1 --set clamp_to_cube=true validate_every=500 precision=fp32

# 100 generated cars
learn3d experiment kato --data CARS100 --output CARS100_OUTPUT --category car --methods Vanilla-AE Proposed --iterations 2000 --seeds 1 --set clamp_to_cube=true validate_every=500

# Table 2
learn3d experiment prgan --data DATA --output OUTPUT --category airplane --iterations 2000 --methods PrGAN --batch-size 16 --set encoder_from_step=1201 encoder_learning_rate=0.001 discriminator_channels=32,64,128,256

learn3d make-dataset --layout kar --views 12 --output KAR --category airplane --source models/airplane --front z --augment 6

# Table 3, as published: one view of each of 2,000 generated airplanes
learn3d make-dataset --layout kar --output KAR_GENERATED --category airplane --procedural 2000
learn3d experiment kar --data KAR_GENERATED --output KAR_GENERATED_OUTPUT --category airplane --methods Vanilla-AE Proposed --iterations 5000 --seeds 1 --set clamp_to_cube=true validate_every=1000 precision=fp32

# Table 3, 12 views of each real airplane
learn3d experiment kar --data KAR --output OUTPUT --category airplane --methods Vanilla-AE Proposed --iterations 2000 --seeds 1 --set clamp_to_cube=true views_per_object=12 validate_every=1000

# Table 4
learn3d experiment ablation --data DATA --output OUTPUT --category airplane --iterations 2000 --set clamp_to_cube=true

# Table 4, longer
learn3d experiment ablation --data DATA --output FP32 --category airplane --methods Proposed "w/o adversarial" --iterations 5000 --seeds 1 --set clamp_to_cube=true validate_every=500 precision=fp32

# Table 4, longer, bf16; airplanes without adversarial loss and chairs without prior were left out
learn3d experiment ablation --data DATA --output LONG --category airplane,chair --methods Proposed "w/o prior" "w/o adversarial" --iterations 5000 --seeds 1 --set clamp_to_cube=true validate_every=500

# Table 6
learn3d experiment mmd --data DATA --output OUTPUT --category airplane,chair,table --iterations 2000 --seeds 3 --set clamp_to_cube=true

# Table 6, longer
learn3d experiment mmd --data DATA --output LONG --category airplane,chair,table --iterations 5000 --seeds 1 --set clamp_to_cube=true validate_every=500

# docs/methods/plus.md
learn3d experiment plus --data DATA --output OUTPUT --category airplane,chair,table --methods Proposed Plus --iterations 2000 --seeds 3 --set clamp_to_cube=true

# The mean shape and the nearest training object of each data set
learn3d experiment kato --data GENERATED --output BASELINES_GENERATED --category airplane --methods Vanilla-AE Proposed --report-only
learn3d experiment kato --data CARS --output BASELINES_CARS --category car --methods Vanilla-AE Proposed --report-only
learn3d experiment kato --data CARS100 --output BASELINES_CARS100 --category car --methods Vanilla-AE Proposed --report-only
learn3d experiment kato --data DATA --output BASELINES_DEBIAN --category airplane,chair,table --methods Vanilla-AE Proposed --report-only
learn3d experiment kato --data DATA --output BASELINES_AIRPLANES --category airplane --methods Vanilla-AE Proposed --report-only

# docs/short-trainings.md

# Table 5
learn3d experiment bins --data KAR --output BINS --category airplane --iterations 2000 --batch-size 32 --set clamp_to_cube=true views_per_object=12 validate_every=1000

# Table 7
learn3d make-dataset --layout pascal3d --output PASCAL --category airplane --source models/airplane --front z --augment 2
learn3d experiment pascal --data PASCAL --output OUTPUT --category airplane --methods Baseline Proposed Plus --iterations 250 --batch-size 32 --seeds 1

# Plus and the recipe on six categories
learn3d experiment plus --data DATA --output SHORT --category airplane,chair,table,cabinet,sofa,lamp --methods Vanilla-AE "Vanilla-AE, all that is shared" Proposed Plus --iterations 400 --seeds 3 --set clamp_to_cube=true

# Supervision
learn3d experiment supervision --data DATA --output SUPERVISION --category airplane,chair,table --iterations 400 --seeds 3

# Unknown poses
learn3d experiment poses --data DATA --output POSES --category airplane,chair,table --iterations 400 --seeds 3
