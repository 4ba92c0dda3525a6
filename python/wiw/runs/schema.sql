-- A run: one experiment, one or more arms on the same episodes. Version 11 (PRAGMA user_version).
CREATE TABLE run (
    id INTEGER PRIMARY KEY CHECK (id = 1),
    created TEXT NOT NULL,          -- ISO 8601, UTC
    wiw_version TEXT NOT NULL,
    config TEXT NOT NULL,           -- JSON: task, arms, seed; what must not differ when a run is resumed
    info TEXT NOT NULL              -- JSON: platform, how to rebuild task and agents, which episodes keep pictures
);

CREATE TABLE episode (              -- the episodes that every arm runs
    episode INTEGER PRIMARY KEY,
    episode_id TEXT NOT NULL,
    scene TEXT NOT NULL,
    start_x REAL NOT NULL, start_y REAL NOT NULL, start_z REAL NOT NULL, start_yaw REAL NOT NULL,  -- metres, radians
    goal_x REAL, goal_y REAL, goal_z REAL,  -- metres; NULL: not known
    goal_yaw REAL NOT NULL,
    geodesic REAL,                  -- metres; NULL: not given, and not measured yet
    info TEXT NOT NULL              -- JSON
);

CREATE TABLE outcome (              -- how an episode ended in an arm; absent while it is to be run
    arm TEXT NOT NULL,
    episode INTEGER NOT NULL REFERENCES episode (episode),
    status TEXT NOT NULL CHECK (status IN ('done', 'error')),   -- error: something broke; never an outcome of the task
    metrics TEXT NOT NULL,          -- JSON: name to number
    seconds REAL NOT NULL,
    error TEXT NOT NULL,            -- traceback; empty where nothing broke
    kind TEXT NOT NULL,             -- environment | agent | worker | world_model/<kind> | vlm/<kind> | judge/<kind>; else empty
    details TEXT NOT NULL,          -- JSON: what the task says of it besides numbers, such as the answer and its judgement
    PRIMARY KEY (arm, episode)
) WITHOUT ROWID;

CREATE TABLE judge (                -- judges that have marked the run's answers since (`wiw judge`)
    digest TEXT PRIMARY KEY,        -- of the description
    description TEXT NOT NULL,      -- JSON: all that its marks depend on: versions, model, prompt digest, seed, temperature
    created TEXT NOT NULL           -- ISO 8601, UTC
) WITHOUT ROWID;

CREATE TABLE judged (               -- outcomes as a judge of table `judge` marks them; the run's own judge is in `outcome`
    judge TEXT NOT NULL REFERENCES judge (digest),
    arm TEXT NOT NULL,
    episode INTEGER NOT NULL REFERENCES episode (episode),
    status TEXT NOT NULL CHECK (status IN ('done', 'error')),
    metrics TEXT NOT NULL,          -- as in table outcome
    error TEXT NOT NULL,
    kind TEXT NOT NULL,             -- judge/<kind>; empty where nothing broke
    details TEXT NOT NULL,
    PRIMARY KEY (judge, arm, episode)
) WITHOUT ROWID;

CREATE TABLE decision (
    arm TEXT NOT NULL,
    episode INTEGER NOT NULL REFERENCES episode (episode),
    decision INTEGER NOT NULL,      -- 0, 1, ... within the episode
    actions TEXT NOT NULL,          -- JSON: of the plan chosen or written anew: primitive ids, or poses [x, y, z, r, p, y, gripper]
    execute INTEGER NOT NULL,       -- how many of them were to be carried out
    executed TEXT NOT NULL,         -- JSON: those that were
    chosen INTEGER,                 -- index into proposals; NULL: written anew
    scores TEXT,                    -- JSON: one a proposal
    proposals TEXT NOT NULL,        -- JSON: [{actions, prior, note[, text]}]
    real_frames TEXT,               -- JSON: for each proposal and frame, whether it is the real view turned
    answer TEXT,                    -- JSON: {label, confidence, probabilities}, or {label, confidence, final} in words:
                                    -- NULL where the task asks for none
    fidelity TEXT,                  -- JSON: {scores, rank, regret, best, psnr, ssim[, lpips]}; NULL: not measured
    exchanges TEXT NOT NULL,        -- JSON: [{purpose, model, said, result, problem, instead}]: a language model's part
    note TEXT NOT NULL,
    path TEXT NOT NULL,             -- JSON: [[x, y, z]] world metres, before the first to after the last primitive
    refused TEXT NOT NULL,          -- JSON: why ways of a gripper ended early, one for each that did
    seconds TEXT NOT NULL,          -- JSON: wall time by stage
    calls TEXT NOT NULL,            -- JSON: consultations, rows and frames asked of the world model
    spent TEXT NOT NULL,            -- JSON: share of calls, rows, frames, retries, cached_rows, vlm_tokens
    before_x REAL NOT NULL, before_y REAL NOT NULL, before_z REAL NOT NULL, before_yaw REAL NOT NULL,
    before_distance REAL, before_geodesic REAL,
    after_x REAL NOT NULL, after_y REAL NOT NULL, after_z REAL NOT NULL, after_yaw REAL NOT NULL,
    after_distance REAL, after_geodesic REAL,
    PRIMARY KEY (arm, episode, decision)
) WITHOUT ROWID;

CREATE TABLE lost (                 -- what an arm spent on decisions that failed or were begun again; in no row above
    arm TEXT NOT NULL,
    name TEXT NOT NULL,             -- as in decision.spent, or seconds
    value REAL NOT NULL,
    PRIMARY KEY (arm, name)
) WITHOUT ROWID;

CREATE TABLE image (
    arm TEXT NOT NULL,
    episode INTEGER NOT NULL,
    decision INTEGER NOT NULL,
    name TEXT NOT NULL,             -- panorama | front | end (with the last) | goal (with decision 0) |
                                    -- imagined/<proposal> | true/<proposal> | believed/<name>
    jpeg BLOB NOT NULL,
    PRIMARY KEY (arm, episode, decision, name)
);

CREATE TABLE film (                 -- an episode from begin to end, in motion, where the task can show it
    arm TEXT NOT NULL,
    episode INTEGER NOT NULL,
    webp BLOB NOT NULL,             -- animated
    PRIMARY KEY (arm, episode)
);

CREATE TABLE scene_map (            -- how a scene looks from above, for the episodes with pictures
    scene TEXT PRIMARY KEY,
    webp BLOB NOT NULL,             -- transparent outside the scene
    world_to_pixel TEXT NOT NULL    -- JSON: 2x3, pixel = A [x, z, 1]
);
