-- A store of format 2, written by the code of commit 9dab14b6 (its last one).
BEGIN TRANSACTION;
CREATE TABLE audit (
    id integer primary key, t real not null, by text not null, what text not null, campaign text not null,
    detail text not null
) strict;
INSERT INTO "audit" VALUES(1,1795000000.0,'ada','submit','narrow-1a2b3c','');
INSERT INTO "audit" VALUES(2,1795000000.0,'ada','pause queue','','');
CREATE TABLE campaign (
    id text primary key, name text not null, task text not null, rig text not null, mode text not null,
    priority integer not null, rank real not null, state text not null, desired_state text not null,
    reason text not null,
    by text not null, created real not null, begun real, ended real, run text, motion_enabled integer not null,
    answers text not null check (json_valid(answers))
) strict;
INSERT INTO "campaign" VALUES('narrow-1a2b3c','narrow','run','left','virtual',0,1.0,'finished','run','','ada',1795000000.0,1795000010.0,1795000100.0,'narrow-20261118-1',0,'{}');
INSERT INTO "campaign" VALUES('wide-4d5e6f','wide','run','left','virtual',3,2.0,'queued','run','','ada',1795000000.0,NULL,NULL,NULL,0,'{}');
CREATE TABLE flag (name text primary key, value text not null check (json_valid(value))) strict;
INSERT INTO "flag" VALUES('paused','{"by": "ada", "time": 1795000000.0}');
CREATE TABLE question (
    id integer primary key, campaign text not null, rig text not null, kind text not null, about text not null,
    text text not null, problem text not null, wants text not null, options text not null check (json_valid(options)),
    details text not null check (json_valid(details)), hands integer not null, asked real not null,
    answer text, by text, answered real, closed text
) strict;
INSERT INTO "question" VALUES(1,'narrow-1a2b3c','left','unknown','unknown pour','What did pour 3 do?','','option','["lost", "repeat"]','{"load_g": 60.0}',0,1795000000.0,'lost','ada',1795000000.0,'answered');
CREATE INDEX campaign_by_state on campaign (state, rig);
CREATE INDEX question_open on question (closed, answered);
CREATE TRIGGER audit_is_never_changed before update on audit begin
    select raise(abort, 'audit entries are append-only'); end;
CREATE TRIGGER audit_is_never_deleted before delete on audit begin
    select raise(abort, 'audit entries are append-only'); end;
COMMIT;
pragma user_version = 2;
