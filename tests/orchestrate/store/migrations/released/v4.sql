SET statement_timeout = 0;
SET lock_timeout = 0;
SET idle_in_transaction_session_timeout = 0;
SET client_encoding = 'UTF8';
SET standard_conforming_strings = on;
SELECT pg_catalog.set_config('search_path', '', false);
SET check_function_bodies = false;
SET xmloption = content;
SET client_min_messages = warning;
SET row_security = off;
CREATE SCHEMA "released";
SET default_tablespace = '';
SET default_table_access_method = "heap";
CREATE TABLE "released"."alembic_version" (
    "version_num" "text" NOT NULL
);
CREATE TABLE "released"."assessment" (
    "trial_id" bigint NOT NULL,
    "t" integer NOT NULL,
    "measure" "text" NOT NULL,
    "value" double precision
);
CREATE TABLE "released"."attempt" (
    "trial_id" bigint NOT NULL,
    "attempt" integer NOT NULL,
    "launch_id" bigint NOT NULL,
    "outcome" "text",
    "cause" "text",
    "node" "text",
    "pid" integer,
    "claimed" "text" NOT NULL,
    "started" "text",
    "ended" "text",
    "wall_seconds" double precision,
    "cpu_seconds" double precision,
    "peak_memory_bytes" bigint,
    "error_id" bigint
);
CREATE TABLE "released"."config" (
    "config_id" bigint NOT NULL,
    "config_key" "text" NOT NULL,
    "env" "text" NOT NULL,
    "policy" "text" NOT NULL,
    "model" "text" NOT NULL,
    "learner" "text" NOT NULL,
    "width" integer,
    "depth" integer,
    "horizon" integer NOT NULL,
    "dt" double precision NOT NULL,
    "gamma" double precision NOT NULL,
    "config_json" "text" NOT NULL,
    "label" "text" NOT NULL
);
CREATE SEQUENCE "released"."config_config_id_seq"
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE "released"."config_config_id_seq" OWNED BY "released"."config"."config_id";
CREATE TABLE "released"."error" (
    "error_id" bigint NOT NULL,
    "hash" "text" NOT NULL,
    "type" "text" NOT NULL,
    "message" "text" NOT NULL,
    "traceback" "text" NOT NULL
);
CREATE SEQUENCE "released"."error_error_id_seq"
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE "released"."error_error_id_seq" OWNED BY "released"."error"."error_id";
CREATE TABLE "released"."launch" (
    "launch_id" bigint NOT NULL,
    "token" "text" NOT NULL,
    "state" "text" NOT NULL,
    "started" "text" NOT NULL,
    "ended" "text",
    "lease_until" double precision,
    "host" "text" NOT NULL,
    "pid" integer NOT NULL,
    "argv" "text" NOT NULL,
    "overrides" "text" NOT NULL,
    "git_commit" "text",
    "git_dirty" integer,
    "git_diff_hash" "text",
    "versions" "text" NOT NULL,
    "exit_code" integer,
    CONSTRAINT "state_is_known" CHECK (("state" = ANY (ARRAY['running'::"text", 'done'::"text", 'failed'::"text", 'interrupted'::"text", 'lost'::"text"])))
);
CREATE SEQUENCE "released"."launch_launch_id_seq"
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE "released"."launch_launch_id_seq" OWNED BY "released"."launch"."launch_id";
CREATE TABLE "released"."step" (
    "trial_id" bigint NOT NULL,
    "t" integer NOT NULL,
    "loss" double precision,
    "reachable_loss" double precision,
    "plan_us" double precision,
    "learn_us" double precision,
    "evaluate_us" double precision
);
CREATE TABLE "released"."trajectory" (
    "trial_id" bigint NOT NULL,
    "dtype" "text" NOT NULL,
    "states_shape" "text" NOT NULL,
    "states" "bytea" NOT NULL,
    "inputs_shape" "text" NOT NULL,
    "inputs" "bytea" NOT NULL,
    "parameters_shape" "text" NOT NULL,
    "parameters" "bytea" NOT NULL
);
CREATE TABLE "released"."trial" (
    "trial_id" bigint NOT NULL,
    "trial_key" "text" NOT NULL,
    "config_id" bigint NOT NULL,
    "seed" bigint NOT NULL,
    "status" "text" NOT NULL,
    "owner" bigint,
    "attempt" integer NOT NULL,
    "n_steps" integer,
    "final_loss" double precision,
    "best_loss" double precision,
    "diverged_at" integer,
    "wall_seconds" double precision,
    "cpu_seconds" double precision,
    "peak_memory_bytes" bigint,
    "node" "text",
    "launch_id" bigint,
    "error_id" bigint,
    CONSTRAINT "status_is_known" CHECK (("status" = ANY (ARRAY['pending'::"text", 'running'::"text", 'done'::"text", 'diverged'::"text", 'failed'::"text", 'cancelled'::"text"])))
);
CREATE SEQUENCE "released"."trial_trial_id_seq"
    START WITH 1
    INCREMENT BY 1
    NO MINVALUE
    NO MAXVALUE
    CACHE 1;
ALTER SEQUENCE "released"."trial_trial_id_seq" OWNED BY "released"."trial"."trial_id";
CREATE VIEW "released"."v_assessment" AS
 SELECT "c"."config_key",
    "c"."label",
    "c"."env",
    "c"."policy",
    "c"."model",
    "c"."learner",
    "c"."width",
    "c"."depth",
    "c"."horizon",
    "r"."seed",
    "r"."trial_key",
    "r"."status",
    "a"."t",
    "a"."measure",
    "a"."value"
   FROM (("released"."config" "c"
     JOIN "released"."trial" "r" ON (("r"."config_id" = "c"."config_id")))
     JOIN "released"."assessment" "a" ON (("a"."trial_id" = "r"."trial_id")));
CREATE VIEW "released"."v_curve" AS
 SELECT "c"."config_key",
    "c"."label",
    "c"."env",
    "c"."policy",
    "c"."model",
    "c"."learner",
    "c"."width",
    "c"."depth",
    "r"."seed",
    "s"."t",
    "s"."loss",
    "s"."reachable_loss"
   FROM (("released"."config" "c"
     JOIN "released"."trial" "r" ON (("r"."config_id" = "c"."config_id")))
     JOIN "released"."step" "s" ON (("s"."trial_id" = "r"."trial_id")));
CREATE VIEW "released"."v_curve_stats" AS
 SELECT "sums"."config_key",
    "sums"."label",
    "sums"."env",
    "sums"."policy",
    "sums"."model",
    "sums"."learner",
    "sums"."width",
    "sums"."depth",
    "sums"."t",
    "sums"."n",
    "sums"."n_finite",
    "sums"."mean",
        CASE
            WHEN ("sums"."n_finite" < 2) THEN NULL::double precision
            WHEN ("sums"."squares" <= ((("sums"."n_finite")::double precision * "sums"."mean") * "sums"."mean")) THEN (0.0)::double precision
            ELSE "sqrt"(((("sums"."squares" - ((("sums"."n_finite")::double precision * "sums"."mean") * "sums"."mean")) / (("sums"."n_finite" - 1))::double precision) / ("sums"."n_finite")::double precision))
        END AS "standard_error"
   FROM ( SELECT "v_curve"."config_key",
            "v_curve"."label",
            "v_curve"."env",
            "v_curve"."policy",
            "v_curve"."model",
            "v_curve"."learner",
            "v_curve"."width",
            "v_curve"."depth",
            "v_curve"."t",
            "count"(*) AS "n",
            "count"("v_curve"."loss") AS "n_finite",
            "avg"("v_curve"."loss") AS "mean",
            "sum"(("v_curve"."loss" * "v_curve"."loss")) AS "squares"
           FROM "released"."v_curve"
          GROUP BY "v_curve"."config_key", "v_curve"."label", "v_curve"."env", "v_curve"."policy", "v_curve"."model", "v_curve"."learner", "v_curve"."width", "v_curve"."depth", "v_curve"."t") "sums";
CREATE VIEW "released"."v_failures" AS
 SELECT "c"."config_key",
    "c"."label",
    "c"."env",
    "c"."policy",
    "c"."model",
    "c"."learner",
    "c"."width",
    "c"."depth",
    "r"."seed",
    "r"."trial_key",
    "r"."status",
    "a"."attempt",
    "a"."launch_id",
    "a"."node",
    "a"."ended",
    "a"."cause",
    "e"."type",
    "e"."message",
    "e"."traceback"
   FROM ((("released"."attempt" "a"
     JOIN "released"."error" "e" ON (("e"."error_id" = "a"."error_id")))
     JOIN "released"."trial" "r" ON (("r"."trial_id" = "a"."trial_id")))
     JOIN "released"."config" "c" ON (("c"."config_id" = "r"."config_id")));
CREATE VIEW "released"."v_progress" AS
 SELECT "c"."config_key",
    "c"."label",
    "c"."env",
    "c"."policy",
    "c"."model",
    "c"."learner",
    "c"."width",
    "c"."depth",
    "c"."horizon",
    "c"."dt",
    "c"."gamma",
    "count"(*) AS "n",
    "count"(*) FILTER (WHERE ("r"."status" = 'done'::"text")) AS "n_done",
    "count"(*) FILTER (WHERE ("r"."status" = 'diverged'::"text")) AS "n_diverged",
    "count"(*) FILTER (WHERE ("r"."status" = 'failed'::"text")) AS "n_failed",
    "count"(*) FILTER (WHERE ("r"."status" = 'cancelled'::"text")) AS "n_cancelled",
    "count"(*) FILTER (WHERE ("r"."status" = 'pending'::"text")) AS "n_pending",
    "count"(*) FILTER (WHERE ("r"."status" = 'running'::"text")) AS "n_running"
   FROM ("released"."config" "c"
     JOIN "released"."trial" "r" ON (("r"."config_id" = "c"."config_id")))
  GROUP BY "c"."config_id", "c"."config_key", "c"."label", "c"."env", "c"."policy", "c"."model", "c"."learner", "c"."width", "c"."depth", "c"."horizon", "c"."dt", "c"."gamma";
CREATE VIEW "released"."v_trial" AS
 SELECT "c"."config_key",
    "c"."label",
    "c"."env",
    "c"."policy",
    "c"."model",
    "c"."learner",
    "c"."width",
    "c"."depth",
    "c"."horizon",
    "c"."dt",
    "c"."gamma",
    "r"."seed",
    "r"."trial_id",
    "r"."trial_key",
    "r"."status",
    "r"."attempt",
    "r"."n_steps",
    "r"."final_loss",
    "r"."best_loss",
    "r"."diverged_at",
    "r"."wall_seconds",
    "r"."cpu_seconds",
    "r"."peak_memory_bytes",
    "r"."node",
    "r"."launch_id",
    "e"."type" AS "error_type",
    "e"."message" AS "error_message"
   FROM (("released"."trial" "r"
     JOIN "released"."config" "c" ON (("c"."config_id" = "r"."config_id")))
     LEFT JOIN "released"."error" "e" ON (("e"."error_id" = "r"."error_id")));
ALTER TABLE ONLY "released"."config" ALTER COLUMN "config_id" SET DEFAULT "nextval"('"released"."config_config_id_seq"'::"regclass");
ALTER TABLE ONLY "released"."error" ALTER COLUMN "error_id" SET DEFAULT "nextval"('"released"."error_error_id_seq"'::"regclass");
ALTER TABLE ONLY "released"."launch" ALTER COLUMN "launch_id" SET DEFAULT "nextval"('"released"."launch_launch_id_seq"'::"regclass");
ALTER TABLE ONLY "released"."trial" ALTER COLUMN "trial_id" SET DEFAULT "nextval"('"released"."trial_trial_id_seq"'::"regclass");
INSERT INTO "released"."alembic_version" VALUES ('4');
INSERT INTO "released"."attempt" VALUES (1, 1, 1, 'done', NULL, 'laptop', 27363, '2026-11-21T10:54:43.770733Z', '2026-11-21T10:54:43.779284Z', '2026-11-21T10:54:44.653881Z', 0.8745725700000548, 0.8513966430000001, 220663808, NULL);
INSERT INTO "released"."attempt" VALUES (2, 1, 1, 'done', NULL, 'laptop', 27363, '2026-11-21T10:54:43.778080Z', '2026-11-21T10:54:44.668956Z', '2026-11-21T10:54:44.672533Z', 0.003556284000069354, 0.0035535959999999367, 220663808, NULL);
INSERT INTO "released"."attempt" VALUES (3, 1, 1, 'done', NULL, 'laptop', 27363, '2026-11-21T10:54:44.667550Z', '2026-11-21T10:54:44.683788Z', '2026-11-21T10:54:44.687020Z', 0.003210768999906577, 0.0032082630000001, 220663808, NULL);
INSERT INTO "released"."attempt" VALUES (4, 1, 1, 'diverged', NULL, 'laptop', 27363, '2026-11-21T10:54:44.682438Z', '2026-11-21T10:54:44.691542Z', '2026-11-21T10:54:44.699237Z', 0.007674876000010045, 0.007673108999999956, 220663808, NULL);
INSERT INTO "released"."attempt" VALUES (5, 1, 2, 'done', NULL, 'laptop', 27391, '2026-11-21T10:54:46.080850Z', '2026-11-21T10:54:46.088058Z', '2026-11-21T10:54:46.915677Z', 0.827598068000043, 0.809239628, 220332032, NULL);
INSERT INTO "released"."attempt" VALUES (6, 1, 2, 'failed', 'exception', 'laptop', 27391, '2026-11-21T10:54:46.086992Z', '2026-11-21T10:54:46.925286Z', '2026-11-21T10:54:46.925832Z', 0.00052835600013168, 0.0005276229999999771, 220332032, 1);
INSERT INTO "released"."attempt" VALUES (7, 1, 3, NULL, NULL, NULL, NULL, '2026-11-21T10:54:48.051821Z', NULL, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."attempt" VALUES (8, 1, 3, NULL, NULL, NULL, NULL, '2026-11-21T10:54:48.057584Z', NULL, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."config" VALUES (1, '6d24584babdd65fd965e87b4ab1d1c79dc57d90b21829805de6705588f99c83d', 'pendulum', 'random', 'mlp', 'adam', 2, 1, 25, 0.02, 2, '{"code_version":1,"env":{"dt":0.02,"friction":0.16666666666666666,"gamma":2.0,"gravity":10.0,"grid_half_widths":[3.141592653589793,8.0],"grid_points":[32,32],"horizon":25,"initial_state":[0.001,0.0],"length":1.0,"mass":1.0,"name":"pendulum","noise":0.001,"state_limit":10000.0},"learner":{"beta_1":0.9,"beta_2":0.999,"epsilon":1e-08,"learning_rate":0.002,"name":"adam","window":1},"model":{"depth":1,"name":"mlp","width":2},"path":"kernel","policy":{"name":"random"}}', 'random, adam, horizon 25, depth 1, width 2');
INSERT INTO "released"."config" VALUES (2, '222b66a9f7705a34e89a5f9f9a5e0d9c52317b4d78c299e1d5ca51b70980ec0a', 'pendulum', 'random', 'mlp', 'adam', 2, 1, 25, 0.02, 30, '{"code_version":1,"env":{"dt":0.02,"friction":0.16666666666666666,"gamma":30.0,"gravity":10.0,"grid_half_widths":[3.141592653589793,8.0],"grid_points":[32,32],"horizon":25,"initial_state":[0.001,0.0],"length":1.0,"mass":1.0,"name":"pendulum","noise":0.001,"state_limit":5.0},"learner":{"beta_1":0.9,"beta_2":0.999,"epsilon":1e-08,"learning_rate":0.002,"name":"adam","window":1},"model":{"depth":1,"name":"mlp","width":2},"path":"kernel","policy":{"name":"random"}}', 'random, adam, γ=30, horizon 25, state_limit=5, depth 1, width 2');
INSERT INTO "released"."config" VALUES (3, 'c31195e12a064319310261de90be599bc8144dc6be8890677cc0424e86681b5c', 'pendulum', 'uniform', 'mlp', 'adam', 2, 1, 25, 0.02, 2, '{"code_version":1,"env":{"dt":0.02,"friction":0.16666666666666666,"gamma":2.0,"gravity":10.0,"grid_half_widths":[3.141592653589793,8.0],"grid_points":[32,32],"horizon":25,"initial_state":[0.001,0.0],"length":1.0,"mass":1.0,"name":"pendulum","noise":0.001,"state_limit":10000.0},"learner":{"beta_1":0.9,"beta_2":0.999,"epsilon":1e-08,"learning_rate":0.002,"name":"adam","window":1},"model":{"depth":1,"name":"mlp","width":2},"path":"kernel","policy":{"iterations":8,"name":"uniform"}}', 'uniform, adam, horizon 25, depth 1, width 2');
INSERT INTO "released"."error" VALUES (1, '5891ed999b28c4a6f752ed8e9eac946f2e42fbf4158105c9eb2c537c522bbcb1', 'FloatingPointError', 'a loss of -1 is no norm', 'Traceback (most recent call last):
  File "/opt/dopt/orchestrate/executors/task.py", line 23, in run_task
    outcome = run(task.spec)
              ^^^^^^^^^^^^^^
  File "/opt/dopt/make_v1.py", line 18, in run
    raise FloatingPointError("a loss of -1 is no norm")
FloatingPointError: a loss of -1 is no norm
');
INSERT INTO "released"."launch" VALUES (2, '473f49ed3cca438681e6dc7050d2fa8f', 'failed', '2026-11-21T10:54:46.018394Z', '2026-11-21T10:54:46.933505Z', NULL, 'laptop', 27391, '["orchestrate/launch.py", "-m", "policy=random,uniform"]', '["policy=random,uniform"]', 'c42f8df1f906170df433312ba0419a91b1747886', 0, NULL, '{"dopt": "0.1.0", "hydra-core": "1.3.8", "numba": "0.68.1", "numpy": "2.4.6", "omegaconf": "2.3.1", "python": "3.11.7", "ray": "2.60.0", "scipy": "1.17.1", "sqlalchemy": "2.1.9", "torch": "2.13.0+cpu"}', NULL);
INSERT INTO "released"."launch" VALUES (3, 'f4eb50de1f2f4348834afd594f172f4d', 'running', '2026-11-21T10:54:48.003563Z', NULL, 1795258548.055172, 'laptop', 27441, '["orchestrate/launch.py", "-m", "policy=random,uniform"]', '["policy=random,uniform"]', 'c42f8df1f906170df433312ba0419a91b1747886', 0, NULL, '{"dopt": "0.1.0", "hydra-core": "1.3.8", "numba": "0.68.1", "numpy": "2.4.6", "omegaconf": "2.3.1", "python": "3.11.7", "ray": "2.60.0", "scipy": "1.17.1", "sqlalchemy": "2.1.9", "torch": "2.13.0+cpu"}', NULL);
INSERT INTO "released"."launch" VALUES (1, 'e79c3055b1394a6d8b3dca2c460816da', 'done', '2026-11-21T10:54:43.703162Z', '2026-11-21T10:54:44.704281Z', NULL, 'laptop', 27363, '["orchestrate/launch.py", "-m", "policy=random,uniform"]', '["policy=random,uniform"]', 'c42f8df1f906170df433312ba0419a91b1747886', 0, NULL, '{"dopt": "0.1.0", "hydra-core": "1.3.8", "numba": "0.68.1", "numpy": "2.4.6", "omegaconf": "2.3.1", "python": "3.11.7", "ray": "2.60.0", "scipy": "1.17.1", "sqlalchemy": "2.1.9", "torch": "2.13.0+cpu"}', 0);
INSERT INTO "released"."step" VALUES (1, 0, 11.055598677573238, 3.8934687185491064, 2.1629998683929443, 118.58100008964539, 60.90400004386902);
INSERT INTO "released"."step" VALUES (1, 1, 11.054387725661062, 3.890454208358072, 1.0220000743865967, 6.192000150680542, 12.894000053405762);
INSERT INTO "released"."step" VALUES (1, 2, 11.05326704427128, 3.8874770877797795, 0.5610001087188721, 3.807999849319458, 12.243000030517578);
INSERT INTO "released"."step" VALUES (1, 3, 11.052120846835379, 3.8844776358034236, 0.5310001373291016, 3.5269999504089355, 12.46399998664856);
INSERT INTO "released"."step" VALUES (1, 4, 11.051023546752765, 3.8814825892505778, 0.49000000953674316, 3.447000026702881, 12.753000020980835);
INSERT INTO "released"."step" VALUES (1, 5, 11.04992900413655, 3.878483392307365, 0.6009998321533203, 3.677000045776367, 12.684000015258789);
INSERT INTO "released"."step" VALUES (1, 6, 11.04879270699655, 3.875453504883113, 0.44099998474121094, 3.627000093460083, 12.944000005722046);
INSERT INTO "released"."step" VALUES (1, 7, 11.047623636634858, 3.8723951142456197, 0.5000002384185791, 3.6669998168945312, 12.684000015258789);
INSERT INTO "released"."step" VALUES (1, 8, 11.046431793037359, 3.8693110154617085, 0.4509999752044678, 2.805000066757202, 12.532999992370605);
INSERT INTO "released"."step" VALUES (1, 9, 11.045221944429287, 3.8662158019879382, 0.4609999656677246, 3.496999979019165, 12.864000082015991);
INSERT INTO "released"."step" VALUES (1, 10, 11.043996940443142, 3.863122430679351, 0.6010000705718994, 3.577000141143799, 12.904000043869019);
INSERT INTO "released"."step" VALUES (1, 11, 11.042757876436301, 3.860030726418482, 0.6719999313354492, 3.6670000553131104, 14.648000001907349);
INSERT INTO "released"."step" VALUES (1, 12, 11.041489087739482, 3.8569135596526496, 0.44099998474121094, 3.4570000171661377, 12.964000225067139);
INSERT INTO "released"."step" VALUES (1, 13, 11.040189006518348, 3.853763042495986, 0.4509999752044678, 3.5870001316070557, 10.77999997138977);
INSERT INTO "released"."step" VALUES (1, 14, 11.038861008551967, 3.8505736323110695, 0.5110001564025879, 2.93500018119812, 11.922999858856201);
INSERT INTO "released"."step" VALUES (1, 15, 11.037518241951128, 3.847348174820677, 0.4309999942779541, 3.327000141143799, 11.140000104904175);
INSERT INTO "released"."step" VALUES (1, 16, 11.036164977192334, 3.8440830115808655, 0.4310002326965332, 3.1459999084472656, 11.681999921798706);
INSERT INTO "released"."step" VALUES (1, 17, 11.034799904594491, 3.8407780893208106, 0.47099995613098145, 2.8450000286102295, 11.70199990272522);
INSERT INTO "released"."step" VALUES (1, 18, 11.033418010327866, 3.837432317967884, 0.500999927520752, 3.315999984741211, 11.041000127792358);
INSERT INTO "released"."step" VALUES (1, 19, 11.032012011286104, 3.834044312326001, 0.4010000228881836, 2.805999994277954, 10.84000015258789);
INSERT INTO "released"."step" VALUES (1, 20, 11.030576349400164, 3.8306157824166673, 0.3809998035430908, 3.0160000324249268, 10.859999895095825);
INSERT INTO "released"."step" VALUES (1, 21, 11.029109132128436, 3.8271500504109937, 0.39100027084350586, 2.755999803543091, 11.009999990463257);
INSERT INTO "released"."step" VALUES (1, 22, 11.027609951358494, 3.823648835657117, 0.42100000381469727, 2.9160001277923584, 11.530999898910522);
INSERT INTO "released"."step" VALUES (1, 23, 11.026090918964586, 3.8201306808382047, 0.4610002040863037, 3.065999984741211, 11.390999794006348);
INSERT INTO "released"."step" VALUES (1, 24, 11.02455403339682, 3.8165986102703, 0.41100001335144043, 2.925999879837036, 10.949999809265137);
INSERT INTO "released"."step" VALUES (2, 0, 10.86887055654243, 3.5203682244415395, 2.515000104904175, 32.680999994277954, 32.00999999046326);
INSERT INTO "released"."step" VALUES (2, 1, 10.86962811287032, 3.5222716546419206, 0.5520000457763672, 3.4760000705718994, 11.901999950408936);
INSERT INTO "released"."step" VALUES (2, 2, 10.870326859756021, 3.524137784969787, 0.4510002136230469, 2.934999942779541, 11.190999984741211);
INSERT INTO "released"."step" VALUES (2, 3, 10.871066185742903, 3.52596170229652, 0.42100000381469727, 3.0759999752044678, 11.82200002670288);
INSERT INTO "released"."step" VALUES (2, 4, 10.871684705930925, 3.527502850663397, 0.42100000381469727, 3.004999876022339, 11.302000045776367);
INSERT INTO "released"."step" VALUES (2, 5, 10.872049674282888, 3.5287222881866307, 0.4400002956390381, 3.2159998416900635, 11.510999917984009);
INSERT INTO "released"."step" VALUES (2, 6, 10.872524658406705, 3.529951654224862, 0.43000006675720215, 2.794999837875366, 11.651999950408936);
INSERT INTO "released"."step" VALUES (2, 7, 10.872911830715742, 3.5310094175868714, 0.42100024223327637, 3.0149998664855957, 11.871999979019165);
INSERT INTO "released"."step" VALUES (2, 8, 10.872768037355634, 3.5314700490659683, 0.4500000476837158, 2.815000057220459, 11.382000207901001);
INSERT INTO "released"."step" VALUES (2, 9, 10.872335177472428, 3.531160172767705, 0.42999982833862305, 3.0460000038146973, 11.73200011253357);
INSERT INTO "released"."step" VALUES (2, 10, 10.871802999471582, 3.5303241978634103, 0.4509999752044678, 3.0260000228881836, 11.832000017166138);
INSERT INTO "released"."step" VALUES (2, 11, 10.871198217787992, 3.5291765651574956, 0.4509999752044678, 3.134999990463257, 11.722000122070312);
INSERT INTO "released"."step" VALUES (2, 12, 10.870539650488261, 3.527777557236465, 0.5520000457763672, 2.944999933242798, 11.54099988937378);
INSERT INTO "released"."step" VALUES (2, 13, 10.869835146672546, 3.526195529722703, 0.41100001335144043, 2.9260001182556152, 11.592000007629395);
INSERT INTO "released"."step" VALUES (2, 14, 10.86909144604098, 3.524470563935858, 0.4500000476837158, 2.946000099182129, 11.851999998092651);
INSERT INTO "released"."step" VALUES (2, 15, 10.868312564269148, 3.5226320108757596, 0.4700000286102295, 3.00600004196167, 11.682000160217285);
INSERT INTO "released"."step" VALUES (2, 16, 10.867499144847185, 3.520700483720077, 0.4099998474121094, 2.7750000953674316, 11.631999969482422);
INSERT INTO "released"."step" VALUES (2, 17, 10.866656237997924, 3.51869734376053, 0.4510002136230469, 2.684999942779541, 11.842999935150146);
INSERT INTO "released"."step" VALUES (2, 18, 10.865793473016895, 3.5166444530770913, 0.43000006675720215, 2.945000171661377, 11.842000007629395);
INSERT INTO "released"."step" VALUES (2, 19, 10.864914678579023, 3.5145568198905233, 0.5209999084472656, 2.9659998416900635, 11.722000122070312);
INSERT INTO "released"."step" VALUES (2, 20, 10.864016194849647, 3.5124367986603713, 0.4509999752044678, 2.8949999809265137, 11.591000080108643);
INSERT INTO "released"."step" VALUES (2, 21, 10.863099657229212, 3.510289878494252, 0.4910001754760742, 2.8350000381469727, 11.57099986076355);
INSERT INTO "released"."step" VALUES (2, 22, 10.862169045806167, 3.5081248433588565, 0.4509999752044678, 2.8550000190734863, 11.861999988555908);
INSERT INTO "released"."step" VALUES (2, 23, 10.861231544740125, 3.5059526270491315, 0.501000165939331, 2.924999952316284, 11.651999950408936);
INSERT INTO "released"."step" VALUES (2, 24, 10.86029414271235, 3.503784971388732, 0.4309999942779541, 2.9560000896453857, 11.941999912261963);
INSERT INTO "released"."step" VALUES (3, 0, 10.8185064098409, 3.677936289142814, 2.5239996910095215, 27.772000074386597, 28.61300015449524);
INSERT INTO "released"."step" VALUES (3, 1, 10.818569923182444, 3.675870747645498, 0.630000114440918, 3.876999855041504, 11.812000036239624);
INSERT INTO "released"."step" VALUES (3, 2, 10.81871872437039, 3.673837586443332, 0.4220001697540283, 2.9649999141693115, 11.490999937057495);
INSERT INTO "released"."step" VALUES (3, 3, 10.818844975375603, 3.6717969083487425, 0.5209999084472656, 2.8350000381469727, 11.82200002670288);
INSERT INTO "released"."step" VALUES (3, 4, 10.818962815461756, 3.6697687746312817, 0.5510001182556152, 2.755000114440918, 10.860000133514404);
INSERT INTO "released"."step" VALUES (3, 5, 10.819091990361663, 3.667807825203498, 0.4909999370574951, 3.0250000953674316, 11.833000183105469);
INSERT INTO "released"."step" VALUES (3, 6, 10.819234526923447, 3.665905173704665, 0.5, 3.1059999465942383, 11.151000022888184);
INSERT INTO "released"."step" VALUES (3, 7, 10.819400049617904, 3.664074587356115, 0.4509999752044678, 2.9549999237060547, 11.752000093460083);
INSERT INTO "released"."step" VALUES (3, 8, 10.81958706473878, 3.662372593317391, 0.4309999942779541, 3.186000108718872, 11.941999912261963);
INSERT INTO "released"."step" VALUES (3, 9, 10.819717317431207, 3.660907289964354, 0.4309999942779541, 3.2960000038146973, 11.470999956130981);
INSERT INTO "released"."step" VALUES (3, 10, 10.819688090002101, 3.6597502295417423, 0.4909999370574951, 2.875, 10.730999946594238);
INSERT INTO "released"."step" VALUES (3, 11, 10.819522849661123, 3.6588857395171335, 0.42999982833862305, 2.9049999713897705, 11.411999940872192);
INSERT INTO "released"."step" VALUES (3, 12, 10.819259367907733, 3.6582569958922564, 0.500999927520752, 3.2260000705718994, 11.371999979019165);
INSERT INTO "released"."step" VALUES (3, 13, 10.818899120919165, 3.6578640690883963, 0.42100024223327637, 2.935999870300293, 11.621999979019165);
INSERT INTO "released"."step" VALUES (3, 14, 10.818446029433856, 3.657697445865472, 0.4219999313354492, 2.875, 11.200000047683716);
INSERT INTO "released"."step" VALUES (3, 15, 10.817901320664234, 3.657757269932611, 0.42100024223327637, 2.734999895095825, 11.440999984741211);
INSERT INTO "released"."step" VALUES (3, 16, 10.817264780849857, 3.658031732599658, 0.5709998607635498, 3.1059999465942383, 11.461000204086304);
INSERT INTO "released"."step" VALUES (3, 17, 10.816576539638453, 3.658453690417652, 0.5109999179840088, 3.2960000038146973, 11.520999908447266);
INSERT INTO "released"."step" VALUES (3, 18, 10.815890111971635, 3.658939649109356, 0.3710000514984131, 2.8359999656677246, 11.150999784469604);
INSERT INTO "released"."step" VALUES (3, 19, 10.815217340710229, 3.6594597908163538, 0.4200000762939453, 2.8959999084472656, 10.979999780654907);
INSERT INTO "released"."step" VALUES (3, 20, 10.814594630460281, 3.659953392357895, 0.42099976539611816, 2.7350001335144043, 11.079999923706055);
INSERT INTO "released"."step" VALUES (3, 21, 10.81407700711194, 3.660293917971846, 0.3710000514984131, 2.7250001430511475, 11.030999898910522);
INSERT INTO "released"."step" VALUES (3, 22, 10.813698160055361, 3.660327182406265, 0.42100000381469727, 2.934999942779541, 10.949999809265137);
INSERT INTO "released"."step" VALUES (3, 23, 10.813418491056684, 3.6600742871394027, 0.41100025177001953, 2.7659997940063477, 11.310999870300293);
INSERT INTO "released"."step" VALUES (3, 24, 10.813213726124763, 3.6595321195762183, 0.6120002269744873, 3.125, 11.18999981880188);
INSERT INTO "released"."step" VALUES (4, 0, 11.055598677573238, 6.848372868856432, 1.9530000686645508, 25.177000045776367, 27.651999950408936);
INSERT INTO "released"."step" VALUES (4, 1, 11.054499873418557, 6.8495637743175255, 0.5299999713897705, 4.037999868392944, 11.891999959945679);
INSERT INTO "released"."step" VALUES (4, 2, 11.053601297180704, 6.85096575929301, 0.5509998798370361, 2.995000123977661, 11.54200005531311);
INSERT INTO "released"."step" VALUES (4, 3, 11.0526731420869, 6.852264901519394, 0.4309999942779541, 2.885999917984009, 11.171000003814697);
INSERT INTO "released"."step" VALUES (4, 4, 11.051790657353449, 6.8535493166364905, 0.44099998474121094, 3.0160000324249268, 11.641999959945679);
INSERT INTO "released"."step" VALUES (4, 5, 11.050834799186438, 6.8548580521791, 0.4509999752044678, 2.93500018119812, 11.480999946594238);
INSERT INTO "released"."step" VALUES (4, 6, 11.049804058133022, 6.85615865574156, 0.44099974632263184, 2.805000066757202, 11.460999965667725);
INSERT INTO "released"."step" VALUES (4, 7, 11.048730181876241, 6.857463973567844, 0.4509999752044678, 2.804999828338623, 11.561000108718872);
INSERT INTO "released"."step" VALUES (4, 8, 11.047630692845061, 6.858782739410669, 0.501000165939331, 3.175999879837036, 11.812000036239624);
INSERT INTO "released"."step" VALUES (4, 9, 11.046487248868393, 6.860118468989399, 0.4610002040863037, 3.0759999752044678, 11.650999784469604);
INSERT INTO "released"."step" VALUES (4, 10, 11.045305654448661, 6.861472802537073, 0.5520000457763672, 2.884999990463257, 11.41100001335144);
INSERT INTO "released"."step" VALUES (4, 11, 11.044091404036019, 6.862842844834237, 0.42100000381469727, 2.9060001373291016, 11.41100001335144);
INSERT INTO "released"."step" VALUES (4, 12, 11.042831915145126, 6.864213929110232, 0.4309999942779541, 2.875999927520752, 11.702000141143799);
INSERT INTO "released"."step" VALUES (4, 13, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 14, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 15, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 16, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 17, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 18, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 19, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 20, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 21, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 22, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 23, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (4, 24, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."step" VALUES (5, 0, 11.055598677573238, 3.8934687185491064, 1.7230000495910645, 88.90599989891052, 40.94600009918213);
INSERT INTO "released"."step" VALUES (5, 1, 11.05438791385882, 3.890454227223919, 7.042999982833862, 2.7250001430511475, 7.914999961853027);
INSERT INTO "released"."step" VALUES (5, 2, 11.053282404090787, 3.887463843759058, 1.693000316619873, 1.7329998016357422, 7.793999910354614);
INSERT INTO "released"."step" VALUES (5, 3, 11.052222992941665, 3.884482374835313, 1.6630001068115234, 1.6729998588562012, 7.663999795913696);
INSERT INTO "released"."step" VALUES (5, 4, 11.051167417328875, 3.881497598959636, 1.7140002250671387, 1.5829999446868896, 7.784999847412109);
INSERT INTO "released"."step" VALUES (5, 5, 11.050101494586084, 3.8785050959935, 1.5840001106262207, 1.6319999694824219, 7.803999900817871);
INSERT INTO "released"."step" VALUES (5, 6, 11.049019900223449, 3.8755021424405367, 1.6729998588562012, 1.8840000629425049, 7.765000104904175);
INSERT INTO "released"."step" VALUES (5, 7, 11.047918428994613, 3.8724837540721593, 1.6729998588562012, 1.622999906539917, 7.6650002002716064);
INSERT INTO "released"."step" VALUES (5, 8, 11.046796407835789, 3.869446734107487, 1.6519999504089355, 1.5929999351501465, 7.574000120162964);
INSERT INTO "released"."step" VALUES (5, 9, 11.045651795471496, 3.8663870416611985, 1.622999906539917, 1.623000144958496, 7.563999891281128);
INSERT INTO "released"."step" VALUES (5, 10, 11.044482557111685, 3.8633005210462845, 1.623000144958496, 1.6530001163482666, 7.634000062942505);
INSERT INTO "released"."step" VALUES (5, 11, 11.043287589796018, 3.860184018540889, 1.7029998302459717, 1.7630000114440918, 7.624000072479248);
INSERT INTO "released"."step" VALUES (5, 12, 11.042064629876894, 3.8570337161674377, 1.7739999294281006, 1.693000078201294, 7.543999910354614);
INSERT INTO "released"."step" VALUES (5, 13, 11.040812543010723, 3.8538472868396245, 1.9239997863769531, 1.6640000343322754, 7.71399998664856);
INSERT INTO "released"."step" VALUES (5, 14, 11.039530768836809, 3.85062321499003, 1.7930002212524414, 1.622999906539917, 7.623999834060669);
INSERT INTO "released"."step" VALUES (5, 15, 11.038218535378126, 3.8473602435342653, 1.8029999732971191, 1.7039999961853027, 7.624000072479248);
INSERT INTO "released"."step" VALUES (5, 16, 11.03687526487965, 3.8440576490361122, 1.7630000114440918, 1.5929999351501465, 7.614000082015991);
INSERT INTO "released"."step" VALUES (5, 17, 11.03550020556021, 3.840715046868328, 1.7430002689361572, 1.682999849319458, 7.763999938964844);
INSERT INTO "released"."step" VALUES (5, 18, 11.034092836874446, 3.8373326151408, 1.7230000495910645, 1.6129999160766602, 7.624000072479248);
INSERT INTO "released"."step" VALUES (5, 19, 11.032653255299786, 3.8339109782420344, 1.753000020980835, 1.5729999542236328, 7.664000034332275);
INSERT INTO "released"."step" VALUES (5, 20, 11.03118132936104, 3.830451081887272, 1.7630000114440918, 1.6430001258850098, 7.624000072479248);
INSERT INTO "released"."step" VALUES (5, 21, 11.029677073385633, 3.8269543131556176, 1.742999792098999, 1.6340000629425049, 7.674000024795532);
INSERT INTO "released"."step" VALUES (5, 22, 11.028140782403263, 3.8234223213035086, 1.7730000019073486, 1.5720000267028809, 7.7149999141693115);
INSERT INTO "released"."step" VALUES (5, 23, 11.02657286008348, 3.8198571483277917, 1.8229999542236328, 1.6430001258850098, 7.694000005722046);
INSERT INTO "released"."step" VALUES (5, 24, 11.024973952304356, 3.8162609018834637, 1.8429999351501465, 1.6430001258850098, 7.6540000438690186);
INSERT INTO "released"."trajectory" VALUES (1, '<f8', '[26, 2]', '\xfca9f1d24d62503f00000000000000002836e154a6ba533f4c09a6e100d5bc3f4ab89e36702b6d3fbe8099f79df99b3f8ccc1b893251713f0c0c244a40bacb3fa079b79ec9c4813f21a3e2a268fed43ff4bb91728a448f3fb21fa635a011b83f3ab7acaccc73913fbbf8ce679ae6c93fdc86bcfc2b7e953fafc6755cc94fd03f61e148f81fe79a3f248d045f82f6d33f4a8110add0aea03f0106289a0300b43f6a5b61df278ba13fd106c613a3a469bf031480ee2993a13fe09e226724ff503f4b3cf69f05b4a13fa87e5619ec43c73fd3f6ac7e837aa33f2149a6e09bded03f8708286d462ba63fbb5afaba7118db3f39d2fed4e785aa3f09e189534e6ae43f0601caae9e8bb03f608233a06987e43f2424eafb47cfb33f02ccf05fc0b2e63fe78a074b8177b73fb2873221c1bee73f4b354b86483fbb3f210a5109a06ee33f1fc90d9f9560be3f8dc16f94739ddf3f90e7ae828b73c03f9fbf8c47e81bdb3fc02dc2595685c13f56994b7448f0da3f913450595997c23ff2a8bba58bb6c23f365da6b70ff6c23f8612457c614cc23f5eeec2f22153c33fd3769c945115a63f', '[25, 1]', '\x1e355acfac25fe3f18ca7bfc0c5af6bf5b879bfd846a094015fb65c80898fe3f418775d5606f0ec08d3c30f88356fe3f78b0d66f98dfef3fd7e1aef12793f13f1d97b88839b40dc0a1134f180fd5f2bfca8b438646d2ce3f2a4f48142680094053e90f228e07f93f3fa8964d6e270740e1ce6e9602e80e40c37b1e971f2ddb3f3eeaf1a6a5fef83fabec8634f9cef03f9f0ebf19b2b7fabfc0b3903b6f12f4bf67cbe38070e8dfbfca75c5a1b040e53f7069a6cc6f9f0ec01a38422cf113e63f91e3f82836dbecbf', '[11]', '\x270f2fb5d58ed03f136bb44caa9ecfbf157a1abb2210c63fdf389de2453fc2bf36aa7f4c4bb1d43fca2965305d38d13fb0eddd13b87fbf3f48a780942972c33f1967e1c38dbbc2bf8575f3ef2882e23faa06febb2b31db3f');
INSERT INTO "released"."trajectory" VALUES (2, '<f8', '[26, 2]', '\xfca9f1d24d62503f00000000000000008e4e00e1facc4d3fa26a4f4eae1fc63f713a2bc913a8713f0613701f3c6eb03fa5266210b85d753f3930033bf509c43f55eb12df1d02813fe74924351b31d13fa1f98a0cd24e8c3fef75d52535bdba3f5aaa223e0637903f2b358d6bf574bfbf3dfc4f61fe748b3f32cce6e80b60b93fd67cdd33a44b8f3f83aa63fa245fd13f1069018cb30c953f7da97836674ede3f605e40ce13b09e3fbc25d9e22dc4dc3ff6e5a12f94e1a33fa7ac716ab78bc83f285543a9dfbea53fca03fe4ecee2d63f668752770253a93f0bf9ac1f0b34d13f003fc49d260fac3fb8bcd65a4c7fd53faebba8fe9272af3f65044310195ed43f589190806063b13f51ae4e039ccad13f4e147bd5aed8b23f8dfee74e1e3dc03ff7c501bb9d84b33f16d4b2f702ec8f3f9e8a06762491b33fb1983c9ac34374bfc85c14318c72b33f558bde5b2a1fa83fb4554b07fea8b33f93b18ea1fdeda63ffa7d1d76c3e6b33f86226912da7e9a3f829a48cb67ffb33fad69b6ee3f3d92bf0938aaa766e3b33f51cee34c4fd9aabfd895c3e24c9db33f99e8446cf358cfbf', '[25, 1]', '\x180d21f80214074059aae6b2d07bfcbff102de7fb430f93f735ecc1658acfe3f23476482f23705c047bcfc55ad970dc063649b8f84130e40d5c58eed16a107409195a67f53ea0b409ee6ae6fb6f5cbbf0805a2ec814910c09c37bcabaee107404a371919c85af3bfba9d5c83d38cf63f8c014ef429f2a13fa7b9617856bcd3bfcffba84f821001c06b8864e4ec6ff7bfda16f2e50637a73fb0ca252e46f0f33fdad77f0d5828d63fd3d19e97c7dab33f69a9a19e7585d5bf2071faca582cc8bf37905e0735a406c0', '[11]', '\x12dbf648e5068cbf0027e8d0cd33c13f8d2ef4f6adc2d1bf8e855f30c735d5bf7457309aacb0bc3f5c595e90abbfd6bf005c41f3b232e23f0c860358494ac6bf8fd855a6e13ccfbf070b0450f472dc3f29055e6de0928f3f');
INSERT INTO "released"."trajectory" VALUES (3, '<f8', '[26, 2]', '\xfca9f1d24d62503f0000000000000000e36186d797c84b3fe6094a398bb7c63f467bc8f97bba713f634ce4d179dcb03f0931b78457ee763feeca4335c81cbd3f56c485986ecc7f3fee0c5c9a0f44943fdf7584f56cfc803f44d48df71a34c5bf2551408db220753f4cc68c25c1aac1bf93d66b00366d643f119e58da940abfbf3e773f13f0850d3f3c99a24cbef0cfbf3a7c18a8ef6874bf8d0fced34570d9bf798e257176a58abff4235a98bd8ed9bf90911412eb5295bf100338f8e5f3cabf8fa4d1b331ec99bf552816507b319ebf1cc2b6ad8e7e9abf709aab1f49dfb1bf78a65f0bbf159cbf3e261a0dbaa8b6bf992a9eb361ab9dbf77edf5cd1a4fb8bf919f0099f1929fbffc6fa28b93e4c1bffee225c9ea3ca1bf8215236e21d4ac3f9d5bd912f69ca0bf4582d5feda20d13fe19684201adc9bbf3a30749674b6c43f72338706297498bf1bbe3031d06fcf3fdcabfcdaf87793bf46e3990c1921da3f3611686f020386bfc6e67789d864e03ffaab225be7dc41bf96007ba3ffdcd03fea25277d8d6d723fc6892b6a0998ce3f5ea79551c9e8823f36396e5712c1d43f', '[25, 1]', '\x5726e45a13b5074002ea4e67c44afdbf7a579150df9cea3ff0278bb36e45f8bf79da8c43756708c01d6a3595ac5ede3ff30f732b2a58d23fa1ff2d64d02801c083920ebe350904c0d15c299820e6bfbfbe6c1d995b1908404301e7fbc8070740141a48b5e9ace9bf39c342f1d905ddbf223816beb08dd0bfb6226b366836edbf0e02ee6e3eb60840e465444e5aef0a40d22fe5e7c216febfa192e3fc6b9ff43f313ce483a80b05402294539eed44fb3f609a1fde167410c0164a0bda9462d7bf765aa9a398bdf73f', '[11]', '\x199e67e04f54e03fb9e9e7b116f3d1bf70ae96e9eb98b53f24331baf3948d93ff48dc8bef78ce03f5a70816678bacf3fa5e903858867e03fee8392eb4bebdfbf07932b747a1cc8bf6201e3abcb69d0bf75e7f9bbdc8bd53f');
INSERT INTO "released"."trajectory" VALUES (4, '<f8', '[26, 2]', '\xfca9f1d24d62503f00000000000000002836e154a6ba533f0b313de52820fb3f031fd2abbc07a23f9dd81bba95edda3f5be0af788766a63fe27be10d5d1f0a400be2a652c5f2bb3f39913b2022c313404d8a142b3da0ca3ff1021b035df4f63f0dc3f12d0849ce3fb172bbd8048508402064ef652e0fd33f56e83631ece10e406c08ec352c03d83f889aa5ee97e3124053ecd24ec20fde3f73c11f2dfc92f33f1ec5459094a2df3fb6b87ac3dc59903f9fd5e3e1d6a9df3fb0b4c4b7ed14b73f6386f1bf26cbdf3f871507def5850640000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f', '[25, 1]', '\xcc91640252433c40760db42c6cf434c0e5cec1addcd34740649bdf3b88ae3c40cd2e1ec86a884cc0c438adb81b713c407045d9e89ee12d40baf39372f5793040ab0d2df0f5d84bc06722ca26bea731c00d53df1d22e50c4037ca03b323e84740beeaee3f15773740000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f000000000000f87f', '[11]', '\x72f2a9594b6ecd3fab269977b197d1bf7524f0635de9c23fa84fe2598544bdbfef09d714157ed63f05d6156256cad23f8ec28fec1e1eb83facadd5200010c73f01e365fa6705bebfe5e902168670e33f5b276848a803dd3f');
INSERT INTO "released"."trajectory" VALUES (5, '<f8', '[26, 2]', '\xfca9f1d24d62503f00000000000000002836e154a6ba533f11ccdefb5a9cbe3fd2af3314dd4e6e3fa17600805877ce3f4026edecc792813fb1de83baf1b0d63f22a2537ca02a903f055f6c41a0fcdd3fa909a08936cb993f4d49d9b34b89e23ff7bf129266c6a23fc79508f7abf3e53fc6ecbafb6ebfa93f24f35ec58a37e93faa14bc61c7f4b03fca901ef56852ec3f5c14744aa181b53fb069e59d283eef3f035fe9fe1a89ba3faaa7271a2cfbf03f9092255c2700c03f35ffa487f03bf23f71d3d60a8ff2c23fae1a60baa65ef33fbbd5598b7206c63fe3339132fc63f43ff9dc50501749c93f7c380d399b49f53fa538015a3ab2cc3f7604318f980df63f04c9964ce01dd03fd4b837e66eaff63faf93706e2bedd13f66577cae162ef73f72f656cc85c9d33f7606c1746e8af73fc64c357a6eaad53f86824999fdc4f73f7343b0329292d73f0f9173f758dbf73f68ebbb8dea7ad93f5255b05835cff73fd0490e84a160db3f7e284ad919a2f73ffe66211db843dd3fafe7dffdc053f73f1ef55905e920df3f5491d8d60fe6f63f87ad0693c87ae03fb165f0948858f63f', '[25, 1]', '\x0000000000000040000000000000004000000000000000400000000000000040000000000000004000000000000000400000000000000040000000000000004000000000000000400000000000000040000000000000004000000000000000400000000000000040000000000000004000000000000000400000000000000040000000000000004000000000000000400000000000000040000000000000004000000000000000400000000000000040000000000000004000000000000000400000000000000040', '[11]', '\xd8507c80ca8ad03f6a0c5d504ce1cfbfa7deb45b75a9c63f66a1a58fb047c2bf3dfe3ed2c8d1d43f1d963d2273e6d03f04eee31ebf6ebf3fdaba0d73dc68c33fc6b765ccedb8c2bf2db38935cf7de23f2abe416fff2ddb3f');
INSERT INTO "released"."trial" VALUES (1, 'bbb4bdd2606c74b3af319714c711506a16d5a3de53a3be261f68d13b2518cf00', 1, 0, 'done', NULL, 1, 25, 11.02455403339682, 11.02455403339682, NULL, 0.8745725700000548, 0.8513966430000001, 220663808, 'laptop', 1, NULL);
INSERT INTO "released"."trial" VALUES (2, 'a4b304836d49616f8dde159da7103939db60683024a58dca3f4cf20fed856f7e', 1, 1, 'done', NULL, 1, 25, 10.86029414271235, 10.86029414271235, NULL, 0.003556284000069354, 0.0035535959999999367, 220663808, 'laptop', 1, NULL);
INSERT INTO "released"."trial" VALUES (3, 'fbb0da33b58b3fff7dc18fc5a020e86d59d589e167e95ce891f830f3d571996f', 1, 2, 'done', NULL, 1, 25, 10.813213726124763, 10.813213726124763, NULL, 0.003210768999906577, 0.0032082630000001, 220663808, 'laptop', 1, NULL);
INSERT INTO "released"."trial" VALUES (4, '75048d2bd48226be4d1cfc2d662994be6c01d52edf65895b9a3a41f149f41689', 2, 0, 'diverged', NULL, 1, 13, NULL, 11.042831915145126, 13, 0.007674876000010045, 0.007673108999999956, 220663808, 'laptop', 1, NULL);
INSERT INTO "released"."trial" VALUES (5, '18af6120ac735eef903800691d3656ae210e6dd7aa38d8638ffda01aa0a67048', 3, 0, 'done', NULL, 1, 25, 11.024973952304356, 11.024973952304356, NULL, 0.827598068000043, 0.809239628, 220332032, 'laptop', 2, NULL);
INSERT INTO "released"."trial" VALUES (6, 'c80b5b013de74b03765880959a98be20ee112c5348dc9cbe28057ffd7c3726ac', 3, 1, 'failed', NULL, 1, NULL, NULL, NULL, NULL, 0.00052835600013168, 0.0005276229999999771, 220332032, 'laptop', 2, 1);
INSERT INTO "released"."trial" VALUES (7, '397f89993ef7545c27884dfa224a0d8f49531920d2430799a6322761ec387682', 3, 2, 'running', 3, 1, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL);
INSERT INTO "released"."trial" VALUES (8, 'ce261b336b8783ab71e2438d8c8818075899a9d514c2ec12114825c0fbd8eefe', 3, 3, 'running', 3, 1, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL, NULL);
SELECT pg_catalog.setval('"released"."config_config_id_seq"', 3, true);
SELECT pg_catalog.setval('"released"."error_error_id_seq"', 1, true);
SELECT pg_catalog.setval('"released"."launch_launch_id_seq"', 3, true);
SELECT pg_catalog.setval('"released"."trial_trial_id_seq"', 8, true);
ALTER TABLE ONLY "released"."alembic_version"
    ADD CONSTRAINT "alembic_version_pkey" PRIMARY KEY ("version_num");
ALTER TABLE ONLY "released"."assessment"
    ADD CONSTRAINT "assessment_pkey" PRIMARY KEY ("trial_id", "t", "measure");
ALTER TABLE ONLY "released"."attempt"
    ADD CONSTRAINT "attempt_pkey" PRIMARY KEY ("trial_id", "attempt");
ALTER TABLE ONLY "released"."config"
    ADD CONSTRAINT "config_config_key_key" UNIQUE ("config_key");
ALTER TABLE ONLY "released"."config"
    ADD CONSTRAINT "config_pkey" PRIMARY KEY ("config_id");
ALTER TABLE ONLY "released"."error"
    ADD CONSTRAINT "error_hash_key" UNIQUE ("hash");
ALTER TABLE ONLY "released"."error"
    ADD CONSTRAINT "error_pkey" PRIMARY KEY ("error_id");
ALTER TABLE ONLY "released"."launch"
    ADD CONSTRAINT "launch_pkey" PRIMARY KEY ("launch_id");
ALTER TABLE ONLY "released"."step"
    ADD CONSTRAINT "step_pkey" PRIMARY KEY ("trial_id", "t");
ALTER TABLE ONLY "released"."trajectory"
    ADD CONSTRAINT "trajectory_pkey" PRIMARY KEY ("trial_id");
ALTER TABLE ONLY "released"."trial"
    ADD CONSTRAINT "trial_config_id_seed_key" UNIQUE ("config_id", "seed");
ALTER TABLE ONLY "released"."trial"
    ADD CONSTRAINT "trial_pkey" PRIMARY KEY ("trial_id");
ALTER TABLE ONLY "released"."trial"
    ADD CONSTRAINT "trial_trial_key_key" UNIQUE ("trial_key");
CREATE INDEX "attempt_by_end" ON "released"."attempt" USING "btree" ("ended");
CREATE UNIQUE INDEX "launch_by_token" ON "released"."launch" USING "btree" ("token");
CREATE INDEX "trial_by_config_status" ON "released"."trial" USING "btree" ("config_id", "status");
CREATE INDEX "trial_by_owner" ON "released"."trial" USING "btree" ("owner");
ALTER TABLE ONLY "released"."assessment"
    ADD CONSTRAINT "assessment_trial_id_fkey" FOREIGN KEY ("trial_id") REFERENCES "released"."trial"("trial_id");
ALTER TABLE ONLY "released"."attempt"
    ADD CONSTRAINT "attempt_error_id_fkey" FOREIGN KEY ("error_id") REFERENCES "released"."error"("error_id");
ALTER TABLE ONLY "released"."attempt"
    ADD CONSTRAINT "attempt_launch_id_fkey" FOREIGN KEY ("launch_id") REFERENCES "released"."launch"("launch_id");
ALTER TABLE ONLY "released"."attempt"
    ADD CONSTRAINT "attempt_trial_id_fkey" FOREIGN KEY ("trial_id") REFERENCES "released"."trial"("trial_id");
ALTER TABLE ONLY "released"."step"
    ADD CONSTRAINT "step_trial_id_fkey" FOREIGN KEY ("trial_id") REFERENCES "released"."trial"("trial_id");
ALTER TABLE ONLY "released"."trajectory"
    ADD CONSTRAINT "trajectory_trial_id_fkey" FOREIGN KEY ("trial_id") REFERENCES "released"."trial"("trial_id");
ALTER TABLE ONLY "released"."trial"
    ADD CONSTRAINT "trial_config_id_fkey" FOREIGN KEY ("config_id") REFERENCES "released"."config"("config_id");
ALTER TABLE ONLY "released"."trial"
    ADD CONSTRAINT "trial_error_id_fkey" FOREIGN KEY ("error_id") REFERENCES "released"."error"("error_id");
ALTER TABLE ONLY "released"."trial"
    ADD CONSTRAINT "trial_launch_id_fkey" FOREIGN KEY ("launch_id") REFERENCES "released"."launch"("launch_id");
ALTER TABLE ONLY "released"."trial"
    ADD CONSTRAINT "trial_owner_fkey" FOREIGN KEY ("owner") REFERENCES "released"."launch"("launch_id");
