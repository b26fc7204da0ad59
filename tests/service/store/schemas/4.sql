BEGIN TRANSACTION;
CREATE TABLE capture_counts (
        deleted INTEGER NOT NULL, state TEXT NOT NULL, grade TEXT NOT NULL, captures INTEGER NOT NULL,
        PRIMARY KEY (deleted, state, grade)
    ) WITHOUT ROWID;
INSERT INTO "capture_counts" VALUES(0,'complete','degraded',1);
INSERT INTO "capture_counts" VALUES(1,'failed','',1);
CREATE TABLE captures (
        id TEXT PRIMARY KEY, document TEXT NOT NULL,
        state TEXT GENERATED ALWAYS AS (json_extract(document, '$.state')) VIRTUAL,
        deleted_at TEXT GENERATED ALWAYS AS (json_extract(document, '$.deleted_at')) VIRTUAL
    ) WITHOUT ROWID;
INSERT INTO "captures" VALUES('01a20d8c-a46e-7433-a257-359fd21d4f2b','{"id":"01a20d8c-a46e-7433-a257-359fd21d4f2b","origin":"live","plan":{"source":"sim:?seed=1","frames":null,"seconds":null,"pretrigger_s":0.0,"name":"","notes":"","record":true,"reconstruct":true,"options":{"seconds":null,"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"most_splats":250000,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null,"fov":null,"mosaic":null,"flipped":null},"intrinsics":null},"state":"complete","started_at":"2026-11-21T07:10:00.123456Z","name":"Wohnzimmer","notes":"","keep":false,"reason":"","warnings":[],"sensor":{"width":400,"height":250,"frame_rate_hz":20000.0,"layout":"compact","bit_order":"lsb","flipped":true,"mosaic":null,"intrinsics":null,"response":"integrate-and-fire"},"frames_planned":null,"recording":{"frames":100,"bytes":1250000,"first_frame":0,"lost":0,"lost_by_cause":{},"sha256":null},"verdict":{"grade":"degraded","reasons":["5 frames were lost"]},"counters":null,"ended_at":"2026-11-21T07:10:00.123456Z","deleted_at":null,"group":"01a20d8c-a46e-72b1-8282-496da2e1e3eb","tags":[],"metadata":{}}');
INSERT INTO "captures" VALUES('01a20d8c-a46e-75c1-be8f-097edaace674','{"id":"01a20d8c-a46e-75c1-be8f-097edaace674","origin":"live","plan":{"source":"sim:?seed=1","frames":null,"seconds":null,"pretrigger_s":0.0,"name":"","notes":"","record":true,"reconstruct":true,"options":{"seconds":null,"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"most_splats":250000,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null,"fov":null,"mosaic":null,"flipped":null},"intrinsics":null},"state":"failed","started_at":"2026-11-21T07:10:00.123456Z","name":"Küche","notes":"","keep":false,"reason":"","warnings":[],"sensor":null,"frames_planned":null,"recording":null,"verdict":null,"counters":null,"ended_at":"2026-11-21T07:10:00.123456Z","deleted_at":"2026-11-21T07:10:00.123456Z","group":null,"tags":[],"metadata":{}}');
CREATE TABLE history (schema INTEGER PRIMARY KEY, at TEXT NOT NULL, program TEXT NOT NULL);
INSERT INTO "history" VALUES(2,'2026-11-27T11:03:47.396884+00:00','0.2.0');
INSERT INTO "history" VALUES(3,'2026-11-27T18:23:42.606681+00:00','0.2.0');
INSERT INTO "history" VALUES(4,'2026-11-27T21:52:21.377573+00:00','0.2.0');
CREATE TABLE job_counts (
        capture_id TEXT NOT NULL, state TEXT NOT NULL, jobs INTEGER NOT NULL, PRIMARY KEY (capture_id, state)
    ) WITHOUT ROWID;
INSERT INTO "job_counts" VALUES('','complete',1);
INSERT INTO "job_counts" VALUES('','queued',4);
INSERT INTO "job_counts" VALUES('01a20d8c-a46e-7433-a257-359fd21d4f2b','complete',1);
INSERT INTO "job_counts" VALUES('01a20d8c-a46e-7433-a257-359fd21d4f2b','queued',1);
INSERT INTO "job_counts" VALUES('01a20d8c-a46e-75c1-be8f-097edaace674','queued',3);
CREATE TABLE jobs (
        capture_id TEXT NOT NULL, id TEXT NOT NULL UNIQUE, state TEXT NOT NULL, worth INTEGER NOT NULL,
        PRIMARY KEY (capture_id, id)
    ) WITHOUT ROWID;
INSERT INTO "jobs" VALUES('01a20d8c-a46e-7433-a257-359fd21d4f2b','01a20d8c-a46e-765c-b741-84ea5074fa1e','queued',1);
INSERT INTO "jobs" VALUES('01a20d8c-a46e-7433-a257-359fd21d4f2b','01a20d8c-a46f-7202-a567-6738be8d62d9','complete',1);
INSERT INTO "jobs" VALUES('01a20d8c-a46e-75c1-be8f-097edaace674','01a20d8c-a470-7111-8111-111111111111','queued',1);
INSERT INTO "jobs" VALUES('01a20d8c-a46e-75c1-be8f-097edaace674','01a20d8c-a471-7222-8222-222222222222','queued',1);
INSERT INTO "jobs" VALUES('01a20d8c-a46e-75c1-be8f-097edaace674','01a20d8c-a472-7333-8333-333333333333','queued',1);
CREATE TABLE queue (
        urgency INTEGER NOT NULL, turn TEXT NOT NULL, id TEXT NOT NULL UNIQUE, held INTEGER NOT NULL,
        user TEXT NOT NULL, recording TEXT NOT NULL DEFAULT '', PRIMARY KEY (urgency, turn, id)
    ) WITHOUT ROWID;
INSERT INTO "queue" VALUES(-7,'01a20d8c-a472-7333-8333-333333333333','01a20d8c-a472-7333-8333-333333333333',0,'','01a20d8c-a46e-75c1-be8f-097edaace674');
INSERT INTO "queue" VALUES(0,'01a20d8c-a46e-765c-b741-84ea5074fa1e','01a20d8c-a46e-765c-b741-84ea5074fa1e',0,'','01a20d8c-a46e-7433-a257-359fd21d4f2b');
INSERT INTO "queue" VALUES(0,'01a20d8c-a470-7111-8111-111111111111','01a20d8c-a471-7222-8222-222222222222',1,'','01a20d8c-a46e-75c1-be8f-097edaace674');
INSERT INTO "queue" VALUES(0,'01a20d8c-a471-7222-8222-222222222222','01a20d8c-a470-7111-8111-111111111111',0,'','01a20d8c-a46e-75c1-be8f-097edaace674');
CREATE TABLE queue_blocks (
        digits INTEGER NOT NULL, urgency INTEGER NOT NULL, block TEXT NOT NULL, jobs INTEGER NOT NULL,
        PRIMARY KEY (digits, urgency, block)
    ) WITHOUT ROWID;
INSERT INTO "queue_blocks" VALUES(6,-7,'01a20d',1);
INSERT INTO "queue_blocks" VALUES(6,0,'01a20d',3);
INSERT INTO "queue_blocks" VALUES(8,-7,'01a20d8c',1);
INSERT INTO "queue_blocks" VALUES(8,0,'01a20d8c',3);
INSERT INTO "queue_blocks" VALUES(11,-7,'01a20d8c-a4',1);
INSERT INTO "queue_blocks" VALUES(11,0,'01a20d8c-a4',3);
INSERT INTO "queue_blocks" VALUES(13,-7,'01a20d8c-a472',1);
INSERT INTO "queue_blocks" VALUES(13,0,'01a20d8c-a46e',1);
INSERT INTO "queue_blocks" VALUES(13,0,'01a20d8c-a470',1);
INSERT INTO "queue_blocks" VALUES(13,0,'01a20d8c-a471',1);
CREATE TABLE reconstructions (
        id TEXT PRIMARY KEY, document TEXT NOT NULL,
        capture_id TEXT GENERATED ALWAYS AS (json_extract(document, '$.capture_id')) VIRTUAL,
        state TEXT GENERATED ALWAYS AS (json_extract(document, '$.state')) VIRTUAL,
        priority INTEGER GENERATED ALWAYS AS (json_extract(document, '$.priority')) VIRTUAL
    ) WITHOUT ROWID;
INSERT INTO "reconstructions" VALUES('01a20d8c-a46e-765c-b741-84ea5074fa1e','{"id":"01a20d8c-a46e-765c-b741-84ea5074fa1e","capture_id":"01a20d8c-a46e-7433-a257-359fd21d4f2b","live":false,"state":"queued","created_at":"2026-11-21T07:10:00.123456Z","options":{"seconds":null,"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"most_splats":250000,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null,"fov":null,"mosaic":null,"flipped":null},"priority":0,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":null,"ended_at":null,"task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[],"name":"","notes":"","held":false,"poses_from":"","calibration_from":"","turn":"","user":"","attempt":"","node":""}');
INSERT INTO "reconstructions" VALUES('01a20d8c-a46f-7202-a567-6738be8d62d9','{"id":"01a20d8c-a46f-7202-a567-6738be8d62d9","capture_id":"01a20d8c-a46e-7433-a257-359fd21d4f2b","live":false,"state":"complete","created_at":"2026-11-21T07:10:00.123456Z","options":{"seconds":null,"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"most_splats":250000,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null,"fov":null,"mosaic":null,"flipped":null},"priority":0,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":"2026-11-21T07:10:00.123456Z","ended_at":"2026-11-21T07:10:00.123456Z","task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[],"name":"","notes":"","held":false,"poses_from":"","calibration_from":"","turn":"","user":"","attempt":"","node":""}');
INSERT INTO "reconstructions" VALUES('01a20d8c-a470-7111-8111-111111111111','{"id":"01a20d8c-a470-7111-8111-111111111111","capture_id":"01a20d8c-a46e-75c1-be8f-097edaace674","live":false,"state":"queued","created_at":"2026-11-21T07:10:00.123456Z","options":{"seconds":null,"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"most_splats":250000,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null,"fov":null,"mosaic":null,"flipped":null},"priority":0,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":null,"ended_at":null,"task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[],"name":"","notes":"","held":false,"poses_from":"","calibration_from":"","turn":"01a20d8c-a471-7222-8222-222222222222","user":"","attempt":"","node":""}');
INSERT INTO "reconstructions" VALUES('01a20d8c-a471-7222-8222-222222222222','{"id":"01a20d8c-a471-7222-8222-222222222222","capture_id":"01a20d8c-a46e-75c1-be8f-097edaace674","live":false,"state":"queued","created_at":"2026-11-21T07:10:00.123456Z","options":{"seconds":null,"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"most_splats":250000,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null,"fov":null,"mosaic":null,"flipped":null},"priority":0,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":null,"ended_at":null,"task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[],"name":"","notes":"","held":true,"poses_from":"","calibration_from":"","turn":"01a20d8c-a470-7111-8111-111111111111","user":"","attempt":"","node":""}');
INSERT INTO "reconstructions" VALUES('01a20d8c-a472-7333-8333-333333333333','{"id":"01a20d8c-a472-7333-8333-333333333333","capture_id":"01a20d8c-a46e-75c1-be8f-097edaace674","live":false,"state":"queued","created_at":"2026-11-21T07:10:00.123456Z","options":{"seconds":null,"steps":2000,"seed":0,"window_frames":null,"threads":null,"max_views":400,"most_splats":250000,"memory_mb":512,"refine_poses":true,"method":"spiked","initialisation":null,"pose_step":null,"loss":null,"intrinsics":null,"fov":null,"mosaic":null,"flipped":null},"priority":7,"stage":"waiting","progress":0.0,"tracking_state":"boot","reason":"","attempts":0,"frames":0,"poses":0,"splats":0,"loss":null,"psnr_db":null,"version":0,"white":null,"queue_place":null,"eta_s":null,"started_at":null,"ended_at":null,"task":"reconstruct","maps":[],"part":null,"recognised":null,"warnings":[],"name":"","notes":"","held":false,"poses_from":"","calibration_from":"","turn":"","user":"","attempt":"","node":""}');
CREATE TABLE uploads (id TEXT PRIMARY KEY, document TEXT NOT NULL) WITHOUT ROWID;
CREATE TABLE versions (
        reconstruction_id TEXT NOT NULL, version INTEGER NOT NULL, document TEXT NOT NULL,
        PRIMARY KEY (reconstruction_id, version)
    ) WITHOUT ROWID;
INSERT INTO "versions" VALUES('01a20d8c-a46e-765c-b741-84ea5074fa1e',1,'{"reconstruction_id":"01a20d8c-a46e-765c-b741-84ea5074fa1e","version":1,"at":"2026-11-21T07:10:00.123456Z","splats":10,"poses":20,"white":0.3,"scene_bytes":1000,"psnr_db":null}');
CREATE INDEX captures_by_state ON captures (state);
CREATE INDEX captures_by_group ON captures (json_extract(document, '$.group'));
CREATE INDEX queue_by_user ON queue (urgency, user, turn);
CREATE TRIGGER queue_forgets AFTER DELETE ON reconstructions BEGIN
        DELETE FROM queue WHERE id = OLD.id;
    END;
CREATE INDEX jobs_by_state ON jobs (state, id);
CREATE INDEX jobs_of_capture_by_state ON jobs (capture_id, state, id);
CREATE INDEX jobs_by_worth ON jobs (capture_id, worth, id);
CREATE TRIGGER jobs_counted AFTER INSERT ON jobs BEGIN
        INSERT INTO job_counts VALUES (NEW.capture_id, NEW.state, 1), ('', NEW.state, 1)
            ON CONFLICT DO UPDATE SET jobs = jobs + 1;
    END;
CREATE TRIGGER jobs_recounted AFTER UPDATE OF state ON jobs BEGIN
        UPDATE job_counts SET jobs = jobs - 1 WHERE capture_id IN (OLD.capture_id, '') AND state = OLD.state;
        INSERT INTO job_counts VALUES (NEW.capture_id, NEW.state, 1), ('', NEW.state, 1)
            ON CONFLICT DO UPDATE SET jobs = jobs + 1;
    END;
CREATE TRIGGER jobs_discounted AFTER DELETE ON jobs BEGIN
        UPDATE job_counts SET jobs = jobs - 1 WHERE capture_id IN (OLD.capture_id, '') AND state = OLD.state;
        DELETE FROM job_counts WHERE capture_id = OLD.capture_id AND jobs = 0;
    END;
CREATE TRIGGER jobs_follow AFTER INSERT ON reconstructions BEGIN
        INSERT INTO jobs SELECT json_extract(NEW.document, '$.capture_id'), NEW.id,
            json_extract(NEW.document, '$.state'),
            CASE WHEN json_extract(NEW.document, '$.task') = 'localise' THEN 0
                WHEN json_extract(NEW.document, '$.version') > 0 THEN 2 ELSE 1 END
            WHERE true ON CONFLICT (id) DO UPDATE SET state = excluded.state, worth = excluded.worth
            WHERE state <> excluded.state OR worth <> excluded.worth;
    END;
CREATE TRIGGER jobs_forget AFTER DELETE ON reconstructions BEGIN
        DELETE FROM jobs WHERE id = OLD.id;
    END;
CREATE INDEX queue_released ON queue (urgency, turn, id, recording) WHERE NOT held;
CREATE TRIGGER queue_counted AFTER INSERT ON queue BEGIN
        INSERT INTO queue_blocks SELECT column1, NEW.urgency, substr(NEW.turn, 1, column1), 1
            FROM (VALUES (6), (8), (11), (13)) WHERE true ON CONFLICT DO UPDATE SET jobs = jobs + 1;
    END;
CREATE TRIGGER queue_discounted AFTER DELETE ON queue BEGIN
        INSERT INTO queue_blocks SELECT column1, OLD.urgency, substr(OLD.turn, 1, column1), 0
            FROM (VALUES (6), (8), (11), (13)) WHERE true ON CONFLICT DO UPDATE SET jobs = jobs - 1;
        DELETE FROM queue_blocks WHERE jobs = 0
            AND digits = 6 AND urgency = OLD.urgency AND block = substr(OLD.turn, 1, 6);
        DELETE FROM queue_blocks WHERE jobs = 0
            AND digits = 8 AND urgency = OLD.urgency AND block = substr(OLD.turn, 1, 8);
        DELETE FROM queue_blocks WHERE jobs = 0
            AND digits = 11 AND urgency = OLD.urgency AND block = substr(OLD.turn, 1, 11);
        DELETE FROM queue_blocks WHERE jobs = 0
            AND digits = 13 AND urgency = OLD.urgency AND block = substr(OLD.turn, 1, 13);
    END;
CREATE TRIGGER queue_follows AFTER INSERT ON reconstructions BEGIN
        DELETE FROM queue WHERE id = NEW.id;
        INSERT INTO queue SELECT -coalesce(json_extract(NEW.document, '$.priority'), 0),
            coalesce(nullif(json_extract(NEW.document, '$.turn'), ''), NEW.id), NEW.id,
            coalesce(json_extract(NEW.document, '$.held'), 0), coalesce(json_extract(NEW.document, '$.user'), ''),
            iif(json_extract(NEW.document, '$.task') = 'merge', '', json_extract(NEW.document, '$.capture_id'))
            WHERE json_extract(NEW.document, '$.state') = 'queued';
    END;
CREATE TRIGGER captures_replaced BEFORE INSERT ON captures BEGIN
        UPDATE capture_counts SET captures = captures - 1 WHERE (deleted, state, grade) IN
            (SELECT json_extract(document, '$.deleted_at') IS NOT NULL, json_extract(document, '$.state'),
                coalesce(json_extract(document, '$.verdict.grade'), '') FROM captures WHERE id = NEW.id);
    END;
CREATE TRIGGER captures_counted AFTER INSERT ON captures BEGIN
        INSERT INTO capture_counts VALUES (json_extract(NEW.document, '$.deleted_at') IS NOT NULL,
            json_extract(NEW.document, '$.state'), coalesce(json_extract(NEW.document, '$.verdict.grade'), ''), 1)
            ON CONFLICT DO UPDATE SET captures = captures + 1;
    END;
CREATE TRIGGER captures_discounted AFTER DELETE ON captures BEGIN
        UPDATE capture_counts SET captures = captures - 1 WHERE deleted = (OLD.deleted_at IS NOT NULL)
            AND state = OLD.state AND grade = coalesce(json_extract(OLD.document, '$.verdict.grade'), '');
    END;
COMMIT;
PRAGMA user_version = 4;
